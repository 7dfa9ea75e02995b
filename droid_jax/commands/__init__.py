"""Commands of the program: each parses its options, calls the layers above, and writes a folder."""
