"""What is scored: lungs, waveform, cells, draws, the one loop and the figures."""
