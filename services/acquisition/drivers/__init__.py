"""What drivers of all devices share: packets, frames of bytes, images, tracking and bridges."""
