"""What is done with a plant that is known already: its gains are tried, or computed alone."""
