"""Learning algorithms: they train the networks of all UAVs from collected transitions."""
