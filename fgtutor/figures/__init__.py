"""Every picture and film."""
