"""Images to corners, descriptors and depths; and descriptors to matches."""
