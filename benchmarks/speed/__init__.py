"""Speed: of the step, contact, laws, gradients, the command, other devices."""
