"""Who may do what over HTTP, how much of it, and the record of what was done."""
