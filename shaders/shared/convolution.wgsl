// How kernels of the layers between planes and latents are told what to do.
#define_import_path tcgs::convolution

struct Convolution {
    // channels of the fine side, of the coarse side, edge of the coarse side, unused
    shape: vec4u,
    // first weight, first bias or NONE, first value of the source, first result
    first: vec4u,
    // how it ends, first value of the gate, unused
    ending: vec4u,
}

const NONE: u32 = 0xffffffffu;

// What is below zero becomes zero.
const RELU: u32 = 1u;
// Zero where the gate is not above zero.
const GATE: u32 = 2u;
// Added to what is there.
const ADD: u32 = 3u;
