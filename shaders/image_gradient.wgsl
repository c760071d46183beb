// The gradient of the image loss by each rendered sample: L1's sign, and SSIM's through the second half of the
// window's adjoint (method.md section 1.5). The fourth component, the gradient by alpha, is zero.
#import tcgs::ssim::{Image, REACH, tap, unpack_rgb}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<vec4f>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read> blurred: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> d_image: array<vec4f>;

@compute @workgroup_size(64)
fn image_gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = (group.x + group.y * 65535u) * 64u + local;
    let pixels = image.size.x * image.size.y;
    if pixel >= pixels {
        return;
    }
    let width = i32(image.size.x);
    let row = i32(pixel / image.size.x);
    var mean = vec3f(0.0);
    var variance = vec3f(0.0);
    var covariance = vec3f(0.0);
    for (var offset = -REACH; offset <= REACH; offset++) {
        let at = row + offset;
        if at >= 0 && at < i32(image.size.y) {
            let neighbour = u32(i32(pixel) + offset * width);
            let weight = tap(offset);
            mean += weight * blurred[neighbour].xyz;
            variance += weight * blurred[pixels + neighbour].xyz;
            covariance += weight * blurred[2u * pixels + neighbour].xyz;
        }
    }
    let x = render[pixel].xyz;
    let y = unpack_rgb(photograph[pixel]);
    let d_ssim = mean + 2.0 * x * variance + y * covariance;
    d_image[pixel] = vec4f(image.weights.x * sign(x - y) - image.weights.y * d_ssim, 0.0);
}
