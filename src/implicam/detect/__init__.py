"""From photographs to observations: a ball, a board, dots."""
