"""What was measured: records, how they are read, and what is refused."""
