"""What a retune would do, and what stands in its way: known before anything is moved."""
