"""What flocc's makers run: experiments, benchmarks, reliability measurements, generators of pages. Not in the wheel."""
