//! Exports scenes to other formats and measures how much they differ from the source.

use crate::{
    domain::{
        Background, ByteCounts, Camera, Crop, CropRegion, Digest, ExportFidelity, GaussianScene, Image,
        NearPlane, Problem, ProblemType, Scene, SceneFormat, SceneFrame, Similarity, UpAxis,
        evenly_spaced::evenly_spaced,
    },
    eval::{Target, mean_scores_with, psnr},
    export::{
        SogFile, bake, limited,
        placed::placed,
        spz::{Packed, SpzVersion, to_spz},
        to_glb, to_sog, to_usda,
        world::{Origin, Rounding, in_world_units, rounding},
    },
};
use serde::Serialize;

pub use super::plain_scene::{Baking, PlainScene, REFINEMENT_STEPS, Refined, Refiner, plain, sphere};
use super::{
    crop,
    plain_scene::{MAX_DEGREE, SPHERE_VIEWS, not_exportable, sphere_of},
    scene_file::{self, SceneFile},
    scene_views::SceneViews,
};

/// Cameras on the sphere for comparing the result; different from those above.
const SPHERE_CHECKS: usize = 16;

/// Views in which a service compares an export with its source, and their longer side.
const FIDELITY_VIEWS: usize = 8;
const FIDELITY_SIDE: u32 = 256;

/// How a `.spz` file stores its values.
#[derive(Debug, Serialize)]
pub struct Packing {
    /// Of the format.
    pub version: u32,
    /// Fractional bits of positions.
    pub fractional_bits: u8,
    /// Values clamped to the range.
    pub clamped: usize,
    /// Gaussians left out because they are invisible.
    pub left_out: usize,
}

/// A scene with fewer Gaussians than it has.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Limited {
    /// How many there were.
    pub of: usize,
    /// How many views say which of them are shown most.
    pub views: usize,
}

/// How a file is to be written.
#[derive(Debug, Clone, Copy)]
pub struct ExportSettings {
    /// One of [`SceneFormat::EXPORTS`].
    pub format: SceneFormat,
    /// Highest degree of the spherical harmonics.
    pub degree: u8,
    /// Where its coordinates begin.
    pub origin: Origin,
    /// The axis that points up, if the scene was turned.
    pub up: Option<UpAxis>,
    /// From the source's world to the file's.
    pub similarity: Similarity,
    /// Most Gaussians.
    pub limit: Option<usize>,
    /// The region whose Gaussians are kept, in the source's world.
    pub crop: Crop,
}

impl ExportSettings {
    /// The whole scene as it is.
    #[must_use]
    pub fn whole(format: SceneFormat) -> Self {
        let (origin, similarity) = (Origin::Nearby, Similarity::NONE);
        Self { format, degree: MAX_DEGREE, origin, up: None, similarity, limit: None, crop: Crop::None }
    }
}

/// How an exported `.ply` is to be written again.
#[derive(Debug, Clone, Copy)]
pub struct PlacedExport {
    /// One of [`SceneFormat::EXPORTS`].
    pub format: SceneFormat,
    /// The axis that points up, if the scene is turned.
    pub up: Option<UpAxis>,
    /// From its coordinates to the new ones.
    pub similarity: Similarity,
    /// Most Gaussians.
    pub limit: Option<usize>,
}

/// A file in another format.
#[derive(Debug)]
pub struct Exported {
    /// The file.
    pub bytes: Vec<u8>,
    /// How many Gaussians it has.
    pub gaussians: usize,
    /// Highest degree of its spherical harmonics.
    pub degree: u8,
    /// How anchors became Gaussians.
    pub baking: Option<Baking>,
    /// How Gaussians became integers.
    pub packing: Option<Packing>,
    /// Which Gaussians were kept; `None` if all were.
    pub limited: Option<Limited>,
    /// Gaussians that a crop removed; `None` without one.
    pub cropped: Option<usize>,
    /// The Gaussians as the file holds them, of a format that is not read.
    held: Option<GaussianScene>,
    /// Where its coordinates are in the world, which not every format states.
    pub place: Place,
    /// Its near plane, likewise.
    near: NearPlane,
    /// From the source's world to its own.
    similarity: Similarity,
}

/// Where the coordinates of an exported file are in the world.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Place {
    /// World coordinates of the file's origin: zero unless the scene is far out.
    pub offset: [f64; 3],
    /// What world coordinates lose in single precision; null for a scene that is not far out.
    pub rounding: Option<Rounding>,
}

/// How much the exported file differs from its source.
#[derive(Debug, Serialize)]
pub struct Quality {
    /// "held-out views" or "sphere".
    pub from: &'static str,
    /// How many.
    pub views: usize,
    /// Mean PSNR of its pictures against the source's, in dB.
    pub psnr_to_source: f64,
    /// Mean PSNR of the source's pictures against the photographs.
    pub psnr_source: Option<f64>,
    /// Mean PSNR of its pictures against the photographs.
    pub psnr: Option<f64>,
    /// The difference of the two.
    pub psnr_lost: Option<f64>,
    /// Adapter and driver.
    pub adapter: String,
}

/// The file of a scene as plain Gaussians, turned, scaled and limited in number; anchors are baked from `cameras`, or from a sphere
/// around them.
///
/// # Errors
/// 422 for a scene that the format cannot hold; faults of the refiner's device.
pub fn export(
    file: &SceneFile,
    settings: &ExportSettings,
    cameras: Option<&[Camera]>,
    refiner: Option<&Refiner>,
) -> Result<Exported, Problem> {
    write(file, plain(file, settings.degree, cameras, refiner)?, settings, cameras)
}

/// As [`export`], of Gaussians that [`plain`] made of the file from these cameras.
///
/// # Errors
/// 422 for a scene that the format cannot hold.
pub fn write(
    file: &SceneFile,
    plain: PlainScene,
    settings: &ExportSettings,
    cameras: Option<&[Camera]>,
) -> Result<Exported, Problem> {
    let ExportSettings { format, origin, up, similarity, limit, crop, .. } = *settings;
    let PlainScene { scene: source, baking } = plain;
    let (source, cropped) = match CropRegion::new(&crop, || cameras.unwrap_or_default().to_vec()) {
        None => (source, None),
        Some(region) => {
            let kept = crop::of_gaussians(&source, &region, &crop)?;
            let removed = source.len() - kept.len();
            (kept, Some(removed))
        }
    };
    let (source, limited) = match limit.filter(|limit| *limit < source.len()) {
        None => (source, None),
        Some(limit) => {
            let views = match cameras {
                Some(cameras) => bake::thinned(cameras),
                None => sphere(file, SPHERE_VIEWS)?,
            };
            let of = Limited { of: source.len(), views: views.len() };
            (limited(&source, &views, limit), Some(of))
        }
    };
    // Plain Gaussians come from a `.ply`, whose coordinates are those of an export already.
    let is_export = matches!(file.scene, Scene::Gaussians(_));
    let is_far_out = if is_export { !source.frame.is_world() } else { source.frame.is_far_out() };
    let scene = match origin {
        Origin::Nearby if is_export => source.clone(),
        origin => in_world_units(&source, origin),
    };
    let scene = placed(&scene, &similarity);
    let place =
        Place { offset: scene.frame.offset().to_array(), rounding: is_far_out.then(|| rounding(&source)) };
    let degree = scene.degree;
    let Written { bytes, packing, left_out, held } = written(&scene, file, format, up)?;
    Ok(Exported {
        bytes,
        gaussians: scene.means.len() - left_out,
        degree,
        baking,
        packing,
        limited,
        cropped,
        held,
        place,
        near: scene.near,
        similarity,
    })
}

/// A file's bytes.
#[derive(Default)]
struct Written {
    bytes: Vec<u8>,
    packing: Option<Packing>,
    /// Gaussians that are too faint for the format.
    left_out: usize,
    /// The Gaussians as the file holds them, of a format that is not read.
    held: Option<GaussianScene>,
}

/// The bytes of a scene in one of the formats.
fn written(
    scene: &GaussianScene,
    file: &SceneFile,
    format: SceneFormat,
    up: Option<UpAxis>,
) -> Result<Written, Problem> {
    let packed = |version: SpzVersion| {
        let Packed { bytes, fractional_bits, clamped, left_out, .. } =
            to_spz(scene, version).map_err(not_exportable)?;
        let packing = Packing { version: version.number(), fractional_bits, clamped, left_out };
        Ok(Written { bytes, packing: Some(packing), left_out, ..Written::default() })
    };
    // Floats are those of the scene.
    let exact = |bytes: Vec<u8>| Written { bytes, held: Some(scene.clone()), ..Written::default() };
    match format {
        SceneFormat::Spz => packed(SpzVersion::V4),
        SceneFormat::Spz3 => packed(SpzVersion::V3),
        SceneFormat::Glb => Ok(exact(to_glb(scene).map_err(not_exportable)?)),
        SceneFormat::Usda => Ok(exact(to_usda(scene, up).map_err(not_exportable)?.into_bytes())),
        SceneFormat::Sog => {
            let SogFile { bytes, scene, left_out } = to_sog(scene).map_err(not_exportable)?;
            Ok(Written { bytes, left_out, held: Some(scene), ..Written::default() })
        }
        SceneFormat::Ply | SceneFormat::Tcgs | SceneFormat::Safetensors => {
            let bytes = scene_file::write_gaussians(scene, file.background, file.dataset);
            Ok(Written { bytes, ..Written::default() })
        }
    }
}

/// An exported `.ply`, turned, scaled and limited in number, in any of the formats. `cameras`, or a sphere if there are none, decide
/// which Gaussians are kept.
///
/// # Errors
/// 422 for a scene that the format cannot hold.
pub fn place(ply: &[u8], placed: &PlacedExport, cameras: &[Camera]) -> Result<Vec<u8>, Problem> {
    let file = scene_file::read(ply)?;
    let PlacedExport { format, up, similarity, limit } = *placed;
    let settings = ExportSettings { up, similarity, limit, ..ExportSettings::whole(format) };
    Ok(export(&file, &settings, (!cameras.is_empty()).then_some(cameras), None)?.bytes)
}

/// Renders `source` and `exported`, as read back from its bytes, from the same cameras: those of `photographs`, which must be over
/// the source's background, or without any from a sphere around the scene.
///
/// # Errors
/// Faults of the device.
pub fn compare(
    source: &SceneViews,
    exported: &Exported,
    background: Background,
    photographs: Option<&[(String, Camera, Target)]>,
) -> Result<Quality, Problem> {
    let similarity = exported.similarity;
    let exported = exported_beside(source, exported, background)?;
    let pair = |camera: &Camera| pair(source, &exported, camera, &similarity);
    let mut to_source = Vec::new();
    let (mut of_source, mut of_exported) = (None, None);
    let photographs = photographs.filter(|photographs| !photographs.is_empty());
    match photographs {
        Some(photographs) => {
            let (mut before, mut after) = (Vec::new(), Vec::new());
            for (name, camera, photograph) in photographs {
                let pair = pair(camera)?;
                to_source.push(pair.psnr);
                before.push(photograph.score(name, &pair.source).ok_or_else(different)?);
                after.push(photograph.score(name, &pair.exported).ok_or_else(different)?);
            }
            of_source = mean_scores_with(&before, None).psnr;
            of_exported = mean_scores_with(&after, None).psnr;
        }
        None => {
            for camera in sphere_of(&source.viewable.scene, SPHERE_CHECKS)? {
                to_source.push(pair(&camera)?.psnr);
            }
        }
    }
    Ok(Quality {
        from: if photographs.is_some() { "held-out views" } else { "sphere" },
        views: to_source.len(),
        psnr_to_source: to_source.iter().sum::<f64>() / to_source.len().max(1) as f64,
        psnr_source: of_source,
        psnr: of_exported,
        psnr_lost: of_source.zip(of_exported).map(|(source, exported)| source - exported),
        adapter: source.adapter.clone(),
    })
}

/// PSNR of an export against its source in small pictures from a few of `cameras`; `None` without cameras.
///
/// # Errors
/// Faults of the device.
pub fn fidelity(
    source: &SceneViews,
    exported: &Exported,
    cameras: &[Camera],
) -> Result<Option<ExportFidelity>, Problem> {
    let similarity = exported.similarity;
    let exported = exported_beside(source, exported, source.viewable.background)?;
    let (mut sum, mut views) = (0.0, 0_u32);
    for camera in evenly_spaced(cameras, FIDELITY_VIEWS) {
        sum += pair(source, &exported, &camera.within(FIDELITY_SIDE), &similarity)?.psnr;
        views += 1;
    }
    Ok((views > 0).then(|| ExportFidelity { psnr: sum / f64::from(views), views }))
}

/// An exported file's scene, rendered on the source's `background`, at its place and from its near plane, which not every format
/// stores.
fn exported_beside(
    source: &SceneViews,
    exported: &Exported,
    background: Background,
) -> Result<SceneViews, Problem> {
    let mut file = match &exported.held {
        None => scene_file::read(&exported.bytes)?,
        Some(scene) => SceneFile {
            format: SceneFormat::Ply,
            scene: Scene::Gaussians(scene.clone()),
            background,
            decode_sha256: Digest::of(&exported.bytes),
            dataset: None,
            byte_counts: ByteCounts::default(),
        },
    };
    file.background = background;
    if let Scene::Gaussians(scene) = &mut file.scene {
        scene.near = exported.near;
        scene.frame = SceneFrame::new(exported.place.offset.into(), 1.0).unwrap_or_default();
    }
    Ok(source.beside(file))
}

/// A view of two scenes.
struct Pair {
    source: Image,
    exported: Image,
    /// Of one against the other.
    psnr: f64,
}

/// The view from `camera`, and the same view of the exported scene where it is now.
fn pair(
    source: &SceneViews,
    exported: &SceneViews,
    camera: &Camera,
    similarity: &Similarity,
) -> Result<Pair, Problem> {
    let (source, exported) = (source.view(camera)?, exported.view(&similarity.camera(camera))?);
    let psnr = psnr(&source, &exported).ok_or_else(different)?;
    Ok(Pair { source, exported, psnr })
}

fn different() -> Problem {
    Problem::new(ProblemType::Internal, "two pictures of one view differ in size")
}

#[cfg(test)]
mod tests {
    use crate::domain::{Intrinsics, Pose};

    use super::*;

    #[test]
    fn views_to_compare_are_small_and_show_the_same() {
        let of = |width: u32, height: u32| {
            let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 4.0);
            let intrinsics = Intrinsics { fx: 1000.0, fy: 900.0, cx, cy, width, height };
            let pose = Pose::look_at(glam::DVec3::X, glam::DVec3::ZERO, glam::DVec3::Z).expect("a pose");
            Camera { intrinsics, pose }.within(FIDELITY_SIDE).intrinsics
        };
        let shrunk = of(1600, 1200);
        assert_eq!((shrunk.width, shrunk.height), (256, 192));
        assert_eq!([shrunk.fx, shrunk.fy, shrunk.cx, shrunk.cy], [160.0, 144.0, 128.0, 48.0]);
        assert_eq!((of(1200, 1600).width, of(1200, 1600).height), (192, 256));
        assert_eq!((of(48, 32).width, of(48, 32).height), (48, 32), "and none is enlarged");
        assert_eq!((of(10_000, 1).width, of(10_000, 1).height), (256, 1));
    }
    #[test]
    fn a_ply_relative_to_an_offset_is_exported_in_its_place_however_small_it_is() {
        // A millimeter large, ten units from the origin.
        let frame = SceneFrame::around([10.0, 0.0, 0.0].into(), 1e-3).expect("a frame");
        let scene = GaussianScene {
            frame,
            means: vec![[0.5, -1.25, 0.1]],
            log_scales: vec![[-3.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.5],
            sh: vec![[[0.25; 3]; 16]],
            degree: 3,
            ..GaussianScene::default()
        };
        let scene = in_world_units(&scene, Origin::Nearby);
        let ply = scene_file::write_gaussians(&scene, Background::Black, None);
        let file = scene_file::read(&ply).expect("reads");
        let again = export(&file, &ExportSettings::whole(SceneFormat::Ply), None, None).expect("exports");
        assert_eq!(again.bytes, ply);
        assert_eq!(again.place.offset, [10.0, 0.0, 0.0]);
        let settings = ExportSettings { origin: Origin::World, ..ExportSettings::whole(SceneFormat::Ply) };
        let world = export(&file, &settings, None, None).expect("exports");
        assert_eq!(world.place.offset, [0.0; 3]);
        assert!(world.place.rounding.expect("is known").mean_shift > 0.0);
    }
}
