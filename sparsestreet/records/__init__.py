"""What a run leaves on disk. Each module describes one file: the values in it, and the file itself (``file``).

``SUMMARY.read(run)`` reads the summary of the run in a folder. ``RUN``, ``COSTS``, ``QUALITY[split]``, ``LEDGER`` and
the others do the same for theirs. No module here imports torch.
"""
