"""The networks of the UAVs: encoders of observations, actors and critics."""
