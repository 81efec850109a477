"""The command line's groups: each file declares its commands and hands over to the room that does the work."""
