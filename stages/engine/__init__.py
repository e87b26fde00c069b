"""What runs stages: their declaration, what is stale, records, options, export."""
