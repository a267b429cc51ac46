"""What every part stands on: errors, ranges, trees of arrays, compiling, files kept between runs. No physics."""
