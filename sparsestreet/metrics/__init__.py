"""The metrics of images: ``definitions`` says in words what each number means (no torch), other modules compute them.

Nothing is imported here, so that a report can read the definitions without torch.
"""
