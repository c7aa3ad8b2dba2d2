"""Commands that read and write tags: their options, and `read`, `watch` and `write` with tags."""
