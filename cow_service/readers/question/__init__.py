"""What a what-if question says, without looking at the image."""
