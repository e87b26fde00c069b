"""The method: one module for each stage, and the packages that stages use."""
