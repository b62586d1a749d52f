"""What a model and a controller make together: stability, margins, step responses and their figures."""
