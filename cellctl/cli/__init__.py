"""The person's face of cellctl."""
