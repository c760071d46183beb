#define_import_path tcgs::geometry

// Gaussians' geometry, and its gradients, lie in one buffer of three sections of `capacity` rows each: position, relative to an origin that the host knows, and opacity;
// standard deviations along the axes, the fourth unused; the quaternion w, x, y, z. A Gaussian's index is its row in the
// first section.

fn scale_row(capacity: u32, index: u32) -> u32 {
    return capacity + index;
}

fn quat_row(capacity: u32, index: u32) -> u32 {
    return 2u * capacity + index;
}
