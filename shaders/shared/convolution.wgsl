// The uniform of the convolutions between planes and latents.
#define_import_path tcgs::convolution

struct Convolution {
    // channels of the fine side, of the coarse side, edge of the coarse side, unused
    shape: vec4u,
    // first weight, first bias or NONE, first value of the source, first result
    first: vec4u,
    // activation, first value of the gate, unused
    activation: vec4u,
}

const NONE: u32 = 0xffffffffu;

// max(x, 0).
const RELU: u32 = 1u;
// Zero where the gate is not above zero.
const GATE: u32 = 2u;
// Added to the previous value.
const ADD: u32 = 3u;
