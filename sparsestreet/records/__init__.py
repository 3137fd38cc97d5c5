"""What a run leaves on disk, one module a file: the values that it holds, and beside them the file itself (``file``).

``SUMMARY.read(run)`` reads the summary of the run in a folder; so do ``RUN``, ``COSTS``, ``QUALITY[split]``, ``LEDGER``
and the others with theirs. No module here imports torch.
"""
