"""From samples to spectra: lines of periodic records, frequency responses, azimuth and harmonics."""
