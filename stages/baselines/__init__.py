"""Published methods for comparison, written anew from their descriptions."""
