"""The programs of the containers of docker-compose.yml beside the processes themselves: bus, health checks and demo."""
