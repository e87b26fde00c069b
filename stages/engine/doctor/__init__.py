"""What is checked about the installation and the machine."""
