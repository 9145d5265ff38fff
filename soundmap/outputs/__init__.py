"""What a run leaves behind: files that people and other programs read."""
