"""What the commands that open a trained scene have in common."""

import torch


def chosen_device(name: str | None) -> torch.device:
    """The device of that name; None: a GPU if there is one. Raises ValueError for one that is not there."""
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device must be cpu or cuda, got {name!r}") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device={name} asks for a GPU, but torch sees none: say device=cpu, or check the driver")
    return device
