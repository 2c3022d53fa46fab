"""Episodes that were played: their recording, pictures of it, and the page that plays it."""
