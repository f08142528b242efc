"""The options of a script: declared, preset, read from the command line, and stored."""
