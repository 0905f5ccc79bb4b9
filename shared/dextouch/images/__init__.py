"""Still images as JPEG bytes."""
