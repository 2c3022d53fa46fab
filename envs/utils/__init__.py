"""Small tools without knowledge of fires: errors, validation, random numbers, files, buffers."""

from .errors import UserError

__all__ = ["UserError"]
