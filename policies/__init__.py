"""The policies of the UAVs: networks, exploration noise, scripted baselines, trained weights."""
