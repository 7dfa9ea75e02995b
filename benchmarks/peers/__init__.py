"""Other programs that identify parameters, each behind one function, for benchmarks/peer_*.py."""
