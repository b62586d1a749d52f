"""What a linear plant with constant load disturbances leaves unexplained in a record, and what explains it."""
