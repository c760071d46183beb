#define_import_path tcgs::geometry

// The geometry of Gaussians, and its gradients, lie in one buffer of three sections of `capacity` rows each: position and
// opacity; standard deviations along the axes, the fourth unused; the quaternion w, x, y, z. The row of the first is the
// Gaussian's index.

fn scale_row(capacity: u32, index: u32) -> u32 {
    return capacity + index;
}

fn quat_row(capacity: u32, index: u32) -> u32 {
    return 2u * capacity + index;
}
