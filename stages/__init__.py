"""The method: stages and what they are made of."""
