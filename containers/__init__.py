"""What runs inside the containers of docker-compose.yml beside the processes themselves: the bus they share, what keeps
them on it, their health, and the demo that uses them."""
