"""What the scanner keeps in JetStream, and what it reads there."""
