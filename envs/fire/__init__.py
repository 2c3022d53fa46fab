"""Generated fires: scenarios, their seeds, and the equations by which a front spreads."""
