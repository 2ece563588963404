"""Pure controllers, a family a file, and the fixed commands of the expiration."""
