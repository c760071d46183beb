// First half of SSIM's window: along rows, the five moments x, y, x^2, y^2, xy of render and photograph.
#import tcgs::ssim::{Image, REACH, tap, unpack_rgb}

@group(0) @binding(0) var<uniform> image: Image;
@group(0) @binding(1) var<storage, read> render: array<vec4f>;
@group(0) @binding(2) var<storage, read> photograph: array<u32>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4f>;

@compute @workgroup_size(64)
fn ssim_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = (group.x + group.y * 65535u) * 64u + local;
    let pixels = image.size.x * image.size.y;
    if pixel >= pixels {
        return;
    }
    let width = i32(image.size.x);
    let column = i32(pixel % image.size.x);
    var x = vec3f(0.0);
    var y = vec3f(0.0);
    var xx = vec3f(0.0);
    var yy = vec3f(0.0);
    var xy = vec3f(0.0);
    for (var offset = -REACH; offset <= REACH; offset++) {
        let at = column + offset;
        if at >= 0 && at < width {
            let neighbour = u32(i32(pixel) + offset);
            let weight = tap(offset);
            let a = render[neighbour].xyz;
            let b = unpack_rgb(photograph[neighbour]);
            x += weight * a;
            y += weight * b;
            xx += weight * a * a;
            yy += weight * b * b;
            xy += weight * a * b;
        }
    }
    moments[pixel] = vec4f(x, 0.0);
    moments[pixels + pixel] = vec4f(y, 0.0);
    moments[2u * pixels + pixel] = vec4f(xx, 0.0);
    moments[3u * pixels + pixel] = vec4f(yy, 0.0);
    moments[4u * pixels + pixel] = vec4f(xy, 0.0);
}
