"""What the work costs: operations, memory, reports."""
