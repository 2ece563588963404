"""What each part of a design is worth: variants that differ in one thing, beside one base."""
