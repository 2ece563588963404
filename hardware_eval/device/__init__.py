"""The device's side: the program of the ventilator's computer, and the hardware below it."""
