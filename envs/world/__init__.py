"""The physics of one step: motion, field of view, coverage and reward, as tensor operations."""
