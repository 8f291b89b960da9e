"""Charts at the width of a paper's column, as PNG and SVG, in colours that the colour-blind can tell apart."""
