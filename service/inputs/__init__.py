"""What people give: the configuration of the loops, requests and models, and what is wrong with them."""
