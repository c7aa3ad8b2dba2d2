"""Tag lists and profiles as files of their own."""
