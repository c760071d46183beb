// Second half of SSIM's window, along columns, and the SSIM map with its derivatives by E[x], E[x^2] and E[xy].
// Also each pixel's share of the losses: SSIM, L1 and squared error, each summed over the three channels.
#import tcgs::ssim::{Image, REACH, tap, unpack_rgb}

const LUMINANCE: f32 = 0.0001;
const CONTRAST: f32 = 0.0009;

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<vec4f>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read> moments: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> derivatives: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> losses: array<vec4f>;

@compute @workgroup_size(64)
fn ssim_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = (group.x + group.y * 65535u) * 64u + local;
    let pixels = image.size.x * image.size.y;
    if pixel >= pixels {
        return;
    }
    let width = i32(image.size.x);
    let row = i32(pixel / image.size.x);
    var x = vec3f(0.0);
    var y = vec3f(0.0);
    var xx = vec3f(0.0);
    var yy = vec3f(0.0);
    var xy = vec3f(0.0);
    for (var offset = -REACH; offset <= REACH; offset++) {
        let at = row + offset;
        if at >= 0 && at < i32(image.size.y) {
            let neighbour = u32(i32(pixel) + offset * width);
            let weight = tap(offset);
            x += weight * moments[neighbour].xyz;
            y += weight * moments[pixels + neighbour].xyz;
            xx += weight * moments[2u * pixels + neighbour].xyz;
            yy += weight * moments[3u * pixels + neighbour].xyz;
            xy += weight * moments[4u * pixels + neighbour].xyz;
        }
    }
    let variance_x = xx - x * x;
    let variance_y = yy - y * y;
    let covariance = xy - x * y;
    let a1 = 2.0 * x * y + LUMINANCE;
    let a2 = 2.0 * covariance + CONTRAST;
    let b1 = x * x + y * y + LUMINANCE;
    let b2 = variance_x + variance_y + CONTRAST;
    let ssim = a1 * a2 / (b1 * b2);
    let by_variance = -ssim / b2;
    let by_covariance = 2.0 * a1 / (b1 * b2);
    let by_mean = 2.0 * y * a2 / (b1 * b2) - 2.0 * x * ssim / b1 - 2.0 * x * by_variance - y * by_covariance;
    derivatives[pixel] = vec4f(by_mean, 0.0);
    derivatives[pixels + pixel] = vec4f(by_variance, 0.0);
    derivatives[2u * pixels + pixel] = vec4f(by_covariance, 0.0);
    let difference = render[pixel].xyz - unpack_rgb(photograph[pixel]);
    losses[pixel] = vec4f(
        dot(ssim, vec3f(1.0)),
        dot(abs(difference), vec3f(1.0)),
        dot(difference, difference),
        0.0,
    );
}
