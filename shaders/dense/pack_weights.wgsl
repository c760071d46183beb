// The weights of all layers, and of their transposes, for `dense_software`: of each output all inputs, in vectors of four, zero past
// the last.

#import tcgs::index::lane_index

struct Product {
    // inputs, outputs, first weight, vectors an output
    shape: vec4u,
    // distance of weights from one output to the next, from one input to the next, end of the product's vectors, unused
    places: vec4u,
}

@group(0) @binding(0) var<storage, read> products: array<Product>;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
@group(0) @binding(2) var<storage, read_write> packed: array<vec4f>;

fn weight(product: Product, output: u32, input: u32) -> f32 {
    let at = product.shape.z + output * product.places.x + min(input, product.shape.x - 1u) * product.places.y;
    return select(0.0, parameters[at], input < product.shape.x);
}

@compute @workgroup_size(64)
fn pack_weights(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = lane_index(group, local);
    var first = 0u;
    for (var i = 0u; i < arrayLength(&products); i++) {
        let product = products[i];
        let end = product.places.z;
        if at >= first && at < end {
            let output = (at - first) / product.shape.w;
            let input = 4u * (at - first - output * product.shape.w);
            packed[at] = vec4f(
                weight(product, output, input),
                weight(product, output, input + 1u),
                weight(product, output, input + 2u),
                weight(product, output, input + 3u),
            );
        }
        first = end;
    }
}
