"""What a user chooses: dataclasses of options, which need no PyTorch to be read, shown and checked."""
