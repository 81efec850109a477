"""From a camera's frames to its spots: one picture, one source, or all sources of a room."""
