//! Plain Gaussians in the `.spz` file: a header and six arrays of small integers, packed.
//!
//! Versions 3 and 4 hold the same integers in other containers (`container.rs`) and both are written, since no version is
//! read by every viewer. Version 2 is read too.
//!
//! ```text
//! header     u32 magic 'NGSP', u32 version, u32 count, u8 degree, u8 fractional bits, u8 flags, u8 arrays
//!            version 4 only: u32 start of the table, 12 zeros, and at that start for each array u64 packed and u64
//!            unpacked length; before version 4 `arrays` is zero
//! positions  [count][3]  i24, in units of 2^-fractional bits
//! opacities  [count]     u8,  opacity * 255
//! colors    [count][3]  u8,  constant coefficient * 0.15 * 255 + 127.5
//! scales     [count][3]  u8,  (log-scale + 10) * 16
//! rotations  [count]     u32, the index of the largest of x, y, z, w in two bits, then the others in ten: sign, magnitude
//!                        in units of sqrt(1/2) / 511 (version 2: x, y, z in a byte each)
//! harmonics  [count][(degree + 1)^2 - 1][3]  u8, coefficient * 128 + 128, a multiple of 8 at degree 1 and of 16 above
//! ```
//!
//! All little endian. Up to version 3 all of it is one stream of gzip; in version 4 header and table are plain and each array
//! is a zstd frame, with the frame's checksum when this program writes it.
//! **Frame**: the file's axes are right, up, back, where `.ply` is taken for right, down, front by every
//! converter; so y and z change their signs on the way, and with them the rotations and harmonics that are odd in them. A
//! `.spz` and a `.ply` of one scene coincide in a viewer.
//!
//! **What rounding costs**: at most half a position unit (this program takes 2^-12 world units, or finer where Gaussians
//! are small, see [`Packed::fractional_bits`]), 1/32 of a logarithm in scale (3 %), 0.0014 in a quaternion's components,
//! 1/510 in opacity, 0.0037 in a color, and 1/32 or 1/16 in a coefficient above the constant one: these are where the
//! loss is. Values out of range are held at its ends and counted.

mod container;
mod pack;
mod unpack;

use glam::DVec3;
use thiserror::Error;

pub use pack::{Packed, to_spz};
pub use unpack::{from_spz, packed_lengths};

use crate::domain::{gaussians::SH_COEFFICIENTS, harmonics};

/// First bytes of the payload, and of a whole file of version 4.
pub const MAGIC: [u8; 4] = *b"NGSP";

/// Arrays behind the header.
const ARRAYS: usize = 6;

/// Constant coefficients are stored in this unit.
const COLOR_UNIT: f64 = 0.15 * 255.0;

/// The file's positions are this many bits wide, sign included.
const POSITION_BITS: u32 = 24;

/// Largest magnitude of a rotation's stored component.
const ROTATION_MAX: u32 = 511;

/// A version that is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpzVersion {
    /// One stream of gzip.
    V3,
    /// A zstd frame for each array.
    V4,
}

impl SpzVersion {
    /// The number in the header.
    #[must_use]
    pub fn number(self) -> u32 {
        match self {
            SpzVersion::V3 => 3,
            SpzVersion::V4 => 4,
        }
    }
}

/// What is wrong with a `.spz` file, or with a scene that is to become one.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SpzError {
    /// The file is not gzip, or damaged.
    #[error("the file cannot be unpacked with gzip: {0}")]
    Gzip(String),
    /// An array of version 4 is not zstd, or damaged.
    #[error("an array cannot be unpacked with zstd: {0}")]
    Zstd(String),
    /// The payload begins with something else.
    #[error("the payload does not begin with 'NGSP'")]
    NotSpz,
    /// A version that is not read.
    #[error("the file is of version {0}; versions 2 to 4 are read")]
    Version(u32),
    /// A version in the other versions' container.
    #[error("the header states version {0}, which has another container; gzip holds versions 2 and 3")]
    Container(u32),
    /// The file ends before what its header or table states.
    #[error("the file ends too early; it was cut short")]
    Cut,
    /// The table of a version 4 file does not list the arrays that its header states, or bytes follow them.
    #[error("the table of arrays does not fit the header and the file's length")]
    Table,
    /// A degree that is not read.
    #[error("spherical harmonics of degree {0}; 0 to 3 are read")]
    Degree(u8),
    /// A unit that makes no sense.
    #[error("positions have {0} fractional bits of {POSITION_BITS}")]
    FractionalBits(u8),
    /// Extensions behind the arrays of an earlier version.
    #[error("the file has extensions, which are read in version 4 only (flags {0:#04x})")]
    Extensions(u8),
    /// Other axes than right, up, back.
    #[error("the file's coordinate system is number {0}; only right, up, back (4) is read")]
    CoordinateSystem(u32),
    /// The header's count and the bytes after it do not agree.
    #[error("{count} Gaussians take {needed} bytes, and the file holds {found}")]
    Length {
        /// The header's count.
        count: u32,
        /// Bytes needed.
        needed: u64,
        /// Bytes present, or the most that there can be.
        found: u64,
    },
    /// The scene's parts do not fit together.
    #[error(transparent)]
    Scene(#[from] crate::domain::anchors::SceneShapeError),
    /// More Gaussians than the header can count.
    #[error("{0} Gaussians are more than the format counts")]
    TooMany(usize),
    /// A position that 24 bits do not hold, even in whole units.
    #[error("Gaussian {index} is {coordinate} from the origin, where the format reaches to 8388607")]
    TooFar {
        /// From 0.
        index: usize,
        /// Its largest coordinate, rounded.
        coordinate: i64,
    },
}

/// Coefficients of a channel above the constant one.
fn rest(degree: u8) -> usize {
    harmonics::functions(degree) - 1
}

/// The multiple that coefficients of a degree are rounded to.
fn harmonic_step(degree: u8) -> f64 {
    if degree == 1 { 8.0 } else { 16.0 }
}

/// Signs of the axes between the two frames.
const FLIP: [f32; 3] = [1.0, -1.0, -1.0];

/// Signs of x, y, z of a quaternion between the two frames.
const FLIP_ROTATION: [f64; 3] = [1.0, -1.0, -1.0];

/// Signs of the harmonics between the two frames: each function is even or odd in y and z together.
fn flip_harmonics() -> [f32; SH_COEFFICIENTS] {
    // No function vanishes here.
    let d = DVec3::new(0.48, 0.36, 0.8);
    let turned = d * DVec3::from(FLIP.map(f64::from));
    let (here, there) = (harmonics::basis(d), harmonics::basis(turned));
    std::array::from_fn(|k| if here[k] * there[k] < 0.0 { -1.0 } else { 1.0 })
}

/// Bytes of a Gaussian in each array behind the header, in the arrays' order.
fn strides(version: u32, degree: u8) -> [usize; ARRAYS] {
    [9, 1, 3, 3, if version >= 3 { 4 } else { 3 }, 3 * rest(degree)]
}

#[cfg(test)]
mod tests;
