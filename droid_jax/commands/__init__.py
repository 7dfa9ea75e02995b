"""The commands of the program. Each parses its options, calls the layers above, and writes a folder."""
