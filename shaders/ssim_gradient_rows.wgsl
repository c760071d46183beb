// First half of the window's adjoint, along rows, for the three derivative fields of SSIM. The window is symmetric
// and zero-padded, so it is its own adjoint.
#import tcgs::ssim::{Image, REACH, tap}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> derivatives: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> blurred: array<vec4f>;

@compute @workgroup_size(64)
fn ssim_gradient_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = (group.x + group.y * 65535u) * 64u + local;
    let pixels = image.size.x * image.size.y;
    if pixel >= pixels {
        return;
    }
    let width = i32(image.size.x);
    let column = i32(pixel % image.size.x);
    var mean = vec3f(0.0);
    var variance = vec3f(0.0);
    var covariance = vec3f(0.0);
    for (var offset = -REACH; offset <= REACH; offset++) {
        let at = column + offset;
        if at >= 0 && at < width {
            let neighbour = u32(i32(pixel) + offset);
            let weight = tap(offset);
            mean += weight * derivatives[neighbour].xyz;
            variance += weight * derivatives[pixels + neighbour].xyz;
            covariance += weight * derivatives[2u * pixels + neighbour].xyz;
        }
    }
    blurred[pixel] = vec4f(mean, 0.0);
    blurred[pixels + pixel] = vec4f(variance, 0.0);
    blurred[2u * pixels + pixel] = vec4f(covariance, 0.0);
}
