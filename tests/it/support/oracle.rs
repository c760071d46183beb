//! The independent values for splatting in `tests/oracles/splatting`, one case a file; one that is too large for the
//! repository is in the shared data.

use std::io::Read as _;

use flate2::read::GzDecoder;
use glam::{DMat3, DVec3};
use safetensors::{Dtype, SafeTensors};
use tcgs_codec::domain::{Camera, Intrinsics, Pose};
use tcgs_render::{Projection, RasterSettings, twin::Gaussian};

use super::{
    sh::{Rows, sh_colors},
    shared::shared,
    tree::root,
};

/// The case that is not committed, with its bound.
pub const LARGE_CASE: (&str, f64) = ("layers2000_saturating", 1e-4);

/// All committed cases, with the bound on relative L2 errors of gradients computed in f32.
pub const CASES: [(&str, f64); 16] = [
    ("all_culled", 1e-4),
    ("antialiased", 1e-4),
    ("base", 1e-4),
    ("camera_inside", 1e-4),
    ("depth_ties", 1e-4),
    ("disc_1e4", 1e-4),
    ("layers2000_thin", 1e-4),
    ("near_straddle", 1e-3),
    ("needle_1e4", 1e-3),
    ("odd_size_offcentre", 1e-4),
    ("offscreen_jacobian_clamp", 1e-4),
    ("opacity_extremes", 1e-4),
    ("quat_unnormalised", 1e-4),
    ("sh_negative_clamp", 1e-4),
    ("subpixel", 1e-4),
    ("very_large", 1e-4),
];

/// A case: its inputs, with the named f64 results at hand.
pub struct Oracle {
    bytes: Vec<u8>,
    culled: bool,
    /// Colors after spherical harmonics, before the clamp at zero is differentiated.
    pub colors: Rows,
}

impl Oracle {
    /// A committed case.
    pub fn load(case: &str) -> Self {
        Self::new(case, committed(&format!("splatting/{case}.safetensors.gz")))
    }

    /// [`LARGE_CASE`], where the shared data is.
    pub fn load_large() -> Option<Self> {
        let (case, _) = LARGE_CASE;
        let path = shared(&format!("oracles/{case}.safetensors"))?;
        Some(Self::new(case, std::fs::read(path).expect("a readable oracle")))
    }

    fn new(case: &str, bytes: Vec<u8>) -> Self {
        let mut oracle = Self { bytes, culled: case == "all_culled", colors: Vec::new() };
        oracle.colors = sh_colors(&oracle.rows("in.means", 3), &oracle.rows("in.sh", 48), oracle.eye());
        oracle
    }

    /// Every number of a tensor.
    pub fn numbers(&self, name: &str) -> Vec<f64> {
        let tensors = SafeTensors::deserialize(&self.bytes).expect("safetensors");
        let tensor = tensors.tensor(name).expect(name);
        let data = tensor.data();
        match tensor.dtype() {
            Dtype::F64 => {
                data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().expect("8"))).collect()
            }
            Dtype::F32 => data
                .chunks_exact(4)
                .map(|b| f64::from(f32::from_le_bytes(b.try_into().expect("4"))))
                .collect(),
            Dtype::I64 => {
                data.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().expect("8")) as f64).collect()
            }
            Dtype::I32 => data
                .chunks_exact(4)
                .map(|b| f64::from(i32::from_le_bytes(b.try_into().expect("4"))))
                .collect(),
            other => panic!("{name} is {other:?}"),
        }
    }

    /// The Gaussians that the reference saw; the row order of its tensors by visible Gaussian.
    pub fn ids(&self) -> Vec<usize> {
        if self.culled { Vec::new() } else { self.numbers("f64.ids").iter().map(|id| *id as usize).collect() }
    }

    /// A gradient in f64; where everything is culled the file has none by visible Gaussian.
    pub fn gradient(&self, name: &str) -> Vec<f64> {
        let per_visible = ["v_means2d", "v_conics", "v_colors", "v_opac_eff"].contains(&name);
        if self.culled && per_visible { Vec::new() } else { self.numbers(&format!("f64.{name}")) }
    }

    /// A tensor as rows of `width` numbers.
    pub fn rows(&self, name: &str, width: usize) -> Rows {
        self.numbers(name).chunks_exact(width).map(<[f64]>::to_vec).collect()
    }

    /// World to camera, as given: rotation and translation.
    pub fn view(&self) -> (DMat3, DVec3) {
        let m = self.rows("in.viewmat", 4);
        let row = |i: usize| DVec3::new(m[i][0], m[i][1], m[i][2]);
        let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        (rotation, DVec3::new(m[0][3], m[1][3], m[2][3]))
    }

    /// The camera center.
    pub fn eye(&self) -> DVec3 {
        let (rotation, translation) = self.view();
        -(rotation.transpose() * translation)
    }

    pub fn camera(&self) -> Camera {
        let k = self.numbers("in.K");
        let size = self.numbers("in.WH_deg_aa");
        let (rotation, translation) = self.view();
        let intrinsics = Intrinsics {
            fx: k[0],
            fy: k[4],
            cx: k[2],
            cy: k[5],
            width: size[0] as u32,
            height: size[1] as u32,
        };
        let pose = Pose::from_world_to_camera(rotation, translation).expect("a rigid pose");
        Camera::new(intrinsics, pose).expect("a camera")
    }

    /// The camera for the twins, with the pose exactly as given.
    pub fn projection(&self) -> Projection {
        let (rotation, translation) = self.view();
        Projection {
            rotation,
            translation,
            near: 0.01,
            low_pass: 0.3,
            ..Projection::new(&self.camera(), &self.settings())
        }
    }

    /// The derivatives of the loss by the image: red, green, blue, alpha.
    pub fn d_image(&self) -> Vec<[f64; 4]> {
        let rgb = self.rows("in.v_rgb", 3);
        rgb.iter().zip(self.numbers("in.v_alpha")).map(|(v, alpha)| [v[0], v[1], v[2], alpha]).collect()
    }

    /// The Gaussians, colored.
    pub fn gaussians(&self) -> Vec<Gaussian> {
        let (means, scales) = (self.rows("in.means", 3), self.rows("in.scales", 3));
        let (quats, opacities) = (self.rows("in.quats", 4), self.numbers("in.opacities"));
        let three = |row: &Vec<f64>| DVec3::new(row[0], row[1], row[2]);
        (0..means.len())
            .map(|i| Gaussian {
                mean: three(&means[i]),
                opacity: opacities[i],
                scale: three(&scales[i]),
                quat: [0, 1, 2, 3].map(|k| quats[i][k]),
                color: three(&self.colors[i]),
            })
            .collect()
    }

    pub fn background(&self) -> DVec3 {
        let bg = self.numbers("in.bg");
        DVec3::new(bg[0], bg[1], bg[2])
    }

    pub fn settings(&self) -> RasterSettings {
        let antialiased = self.numbers("in.WH_deg_aa")[3] != 0.0;
        RasterSettings { near: 0.01, antialiased, ..RasterSettings::default() }
    }
}

/// What a deflated file of `tests/oracles` holds.
pub fn committed(name: &str) -> Vec<u8> {
    let path = root().join("tests/oracles").join(name);
    let file = std::fs::File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let mut bytes = Vec::new();
    GzDecoder::new(file).read_to_end(&mut bytes).expect("gzip");
    bytes
}

/// |a - b| / |b| in L2, or |a| where b vanishes.
pub fn relative_l2(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let difference: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
    let size: f64 = b.iter().map(|b| b * b).sum();
    if size == 0.0 { difference.sqrt() } else { (difference / size).sqrt() }
}
