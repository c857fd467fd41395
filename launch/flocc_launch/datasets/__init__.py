"""Data sets as recordings of robots: `flocc dataset info | convert | split`."""
