"""Pure mathematics on batched tensors: rotations, conics, small dense solves. Knows no image, camera or target."""
