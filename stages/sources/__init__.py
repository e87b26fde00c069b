"""Every kind of input behind one protocol."""
