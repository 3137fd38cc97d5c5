"""What a run leaves on disk, one module a file, written and read in one place. No module here imports torch."""
