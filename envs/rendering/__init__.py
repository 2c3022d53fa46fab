"""Pictures, animations and videos of episodes."""
