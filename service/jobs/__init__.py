"""Jobs: started by a durable engine, pumped, looked after when they end, and what becomes of their results."""
