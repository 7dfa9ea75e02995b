"""What was measured: recordings, their checks, and their files."""
