"""What a run leaves on the disk: its directory, history, checkpoints, fields and pictures."""
