"""Names what replaces the keys of earlier versions."""

REMOVED: dict[str, str] = {}
"""key, or key=value -> a sentence about what to use instead"""
