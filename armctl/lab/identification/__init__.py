"""Parameters of an arm from recordings, and the motions that show them."""
