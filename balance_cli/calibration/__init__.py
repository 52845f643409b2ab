"""Static calibration to the standard of balance practice: terms, regression, choice of terms, loads by iteration."""
