"""Recipes, training, evaluation and the command line."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.trainers.build import make_env

__all__ = ["make_env"]


def __getattr__(name: str) -> Any:
    # Imported when asked for, so that `emberlink --help` need not wait for torch.
    if name == "make_env":
        from emberlink.trainers.build import make_env

        return make_env
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
