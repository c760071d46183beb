//! Anchors as a safetensors file, which every tensor library reads, and back without a loss: what `tcgs decode` writes,
//! and what the `scaffold` baseline is published as.
//!
//! Tensors, with N anchors, F features and K offsets per anchor: `cells` i32 `[N, 3]`, `features` f32 `[N, F]`,
//! `scalings` f32 `[N, 6]` (linear), `offsets` f32 `[N, K, 3]`, `lattice.voxel` f32 `[1]`, `lattice.origin` f32 `[3]`,
//! and for each network `opacity`, `covariance`, `color` and layer i: `NETWORK.i.weight` f32 `[outputs, inputs]`,
//! `NETWORK.i.bias` f32 `[outputs]`. Where some offsets are off there is also `masks` bool `[N, K]`. An anchor's position
//! is `cells * voxel + origin`: cells take the four bytes a coordinate that floats would, and keep the lattice. The
//! metadata key `tcgs` holds a JSON object with `version`, `background`, `dataset` if it is known, `near` where views do not
//! begin at the usual depth, and `unit` if the networks' distances are not in the frame's unit; `version` is 2 then. If coordinates
//! are not the world's there is `frame`, with `offset` and `scale` (world = offset + scale * coordinate); `version` is 3 then. If the
//! networks have more than four inputs beside the feature (harmonics of the view direction), `version` is 4. Everywhere else it is 1.

use std::collections::HashMap;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::domain::{
    AnchorScene, Background, ByteCounts, DenseLayer, Digest, Lattice, Mlp, NearPlane, RenderNetworks,
    SceneFrame, SceneScale, ViewDegree,
};

/// Version of this layout of tensors.
const VERSION: u32 = 1;

/// Version of files that state a scene scale: a reader that ignored it would render another image, and must refuse.
const VERSION_WITH_UNIT: u32 = 2;

/// Version of files that state a frame, likewise.
const VERSION_WITH_FRAME: u32 = 3;

/// Version of files whose networks get harmonics of the view direction, likewise.
const VERSION_WITH_HARMONICS: u32 = 4;

/// Most layers that a file may claim; more than any network of this program has.
const MAX_LAYERS: usize = 16;

/// Why a safetensors file is not a scene.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum AnchorFileError {
    /// The file is not safetensors.
    #[error("not a safetensors file: {0}")]
    Format(String),
    /// The metadata are not those that this module writes.
    #[error(
        "the metadata key 'tcgs' {0}; this reads what `tcgs decode` and `tcgs train --model scaffold` write"
    )]
    Metadata(String),
    /// A tensor is missing, of another type, or of another shape.
    #[error("tensor '{name}' {problem}")]
    Tensor {
        /// Its name.
        name: String,
        /// What is wrong.
        problem: String,
    },
    /// The tensors do not fit together.
    #[error("{0}")]
    Scene(String),
}

/// A file's content.
#[derive(Debug, Clone, PartialEq)]
pub struct AnchorFile {
    /// The scene.
    pub scene: AnchorScene,
    /// The background that it was trained on.
    pub background: Background,
    /// Digest of the dataset that it was trained on, if it is known.
    pub dataset: Option<Digest>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Metadata {
    version: u32,
    background: Background,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    dataset: Option<Digest>,
    #[serde(default, skip_serializing_if = "NearPlane::is_default")]
    near: NearPlane,
    #[serde(rename = "unit", default, skip_serializing_if = "SceneScale::is_default")]
    scene_scale: SceneScale,
    #[serde(default, skip_serializing_if = "SceneFrame::is_world")]
    frame: SceneFrame,
}

/// The bytes of a file; the same content gives the same bytes.
///
/// # Errors
/// [`AnchorFileError::Scene`] for a scene whose parts do not have the lengths that it states.
pub fn write(
    scene: &AnchorScene,
    background: Background,
    dataset: Option<Digest>,
) -> Result<Vec<u8>, AnchorFileError> {
    let (n, f, k) = (scene.len(), scene.feature_dim, scene.offsets_per_anchor);
    let cells = scene.cells.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> =
        vec![("cells".to_owned(), Dtype::I32, vec![n, 3], cells)];
    if has_masks(scene) {
        let masks = scene.masks.iter().map(|kept| u8::from(*kept)).collect();
        tensors.push(("masks".to_owned(), Dtype::BOOL, vec![n, k], masks));
    }
    let mut floats = |name: String, shape: Vec<usize>, values: &[f32]| {
        let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        tensors.push((name, Dtype::F32, shape, bytes));
    };
    floats("features".to_owned(), vec![n, f], &scene.features);
    floats("scalings".to_owned(), vec![n, 6], &scene.scalings);
    floats("offsets".to_owned(), vec![n, k, 3], &scene.offsets);
    floats("lattice.voxel".to_owned(), vec![1], &[scene.lattice.voxel]);
    floats("lattice.origin".to_owned(), vec![3], &scene.lattice.origin);
    for (network, mlp) in networks(&scene.networks) {
        for (index, layer) in mlp.layers.iter().enumerate() {
            let shape = vec![layer.outputs, layer.inputs];
            floats(format!("{network}.{index}.weight"), shape, &layer.weights);
            floats(format!("{network}.{index}.bias"), vec![layer.outputs], &layer.bias);
        }
    }
    let views = tensors
        .iter()
        .map(|(name, dtype, shape, bytes)| Ok((name, TensorView::new(*dtype, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
        .map_err(|error| AnchorFileError::Scene(error.to_string()))?;
    // One key: several would be written in the random order of a hash map.
    let sees_direction_alone = scene.view_degree().is_none_or(ViewDegree::is_default);
    let version = match (sees_direction_alone, scene.frame.is_world(), scene.scene_scale.is_default()) {
        (false, ..) => VERSION_WITH_HARMONICS,
        (true, false, _) => VERSION_WITH_FRAME,
        (true, true, false) => VERSION_WITH_UNIT,
        (true, true, true) => VERSION,
    };
    let AnchorScene { near, scene_scale, frame, .. } = *scene;
    let metadata =
        serde_json::to_string(&Metadata { version, background, dataset, near, scene_scale, frame })
            .map_err(|error| AnchorFileError::Scene(error.to_string()))?;
    safetensors::serialize(views, Some(HashMap::from([("tcgs".to_owned(), metadata)])))
        .map_err(|error| AnchorFileError::Scene(error.to_string()))
}

/// Where the bytes of a file of `total` bytes that holds `scene` go; header and lattice are the container.
#[must_use]
pub fn byte_counts(scene: &AnchorScene, total: u64) -> ByteCounts {
    let floats = |count: usize| (count * size_of::<f32>()) as u64;
    let networks = [&scene.networks.opacity, &scene.networks.covariance, &scene.networks.color];
    let mut counts = ByteCounts {
        total,
        positions: floats(3 * scene.cells.len()),
        networks: networks.iter().map(|network| floats(network.parameters())).sum(),
        masks: if has_masks(scene) { scene.masks.len() as u64 } else { 0 },
        features: floats(scene.features.len()),
        scalings: floats(scene.scalings.len()),
        offsets: floats(scene.offsets.len()),
        ..ByteCounts::default()
    };
    let ByteCounts { positions, networks, masks, features, scalings, offsets, .. } = counts;
    counts.container = total.saturating_sub(positions + networks + masks + features + scalings + offsets);
    counts
}

/// Whether some offset is off; a file in which all are on need not say so.
fn has_masks(scene: &AnchorScene) -> bool {
    scene.masks.iter().any(|kept| !kept)
}

/// The content of a file, checked.
///
/// # Errors
/// [`AnchorFileError`] naming the first error.
pub fn read(bytes: &[u8]) -> Result<AnchorFile, AnchorFileError> {
    let format = |error: safetensors::SafeTensorError| AnchorFileError::Format(error.to_string());
    let tensors = SafeTensors::deserialize(bytes).map_err(format)?;
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
    let text = header
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get("tcgs"))
        .ok_or_else(|| AnchorFileError::Metadata("is missing".to_owned()))?;
    let metadata: Metadata = serde_json::from_str(text)
        .map_err(|error| AnchorFileError::Metadata(format!("cannot be read ({error})")))?;
    if !(VERSION..=VERSION_WITH_HARMONICS).contains(&metadata.version) {
        let known = format!("{VERSION} to {VERSION_WITH_HARMONICS}");
        return Err(AnchorFileError::Metadata(format!("has version {}, not {known}", metadata.version)));
    }

    let mut reader = Reader { tensors, taken: 0 };
    let [n, _] = reader.shape("cells", [None, Some(3)])?;
    let [_, f] = reader.shape("features", [Some(n), None])?;
    let [_, k, _] = reader.shape("offsets", [Some(n), None, Some(3)])?;
    reader.shape("scalings", [Some(n), Some(6)])?;
    reader.shape("lattice.voxel", [Some(1)])?;
    reader.shape("lattice.origin", [Some(3)])?;
    let cells = reader.words("cells", Dtype::I32)?.map(i32::from_le_bytes).collect::<Vec<_>>();
    let origin = reader.floats("lattice.origin")?;
    let scene = AnchorScene {
        lattice: Lattice {
            voxel: reader.floats("lattice.voxel")?[0],
            origin: [origin[0], origin[1], origin[2]],
        },
        cells: cells.chunks_exact(3).map(|cell| [cell[0], cell[1], cell[2]]).collect(),
        feature_dim: f,
        offsets_per_anchor: k,
        features: reader.floats("features")?,
        scalings: reader.floats("scalings")?,
        offsets: reader.floats("offsets")?,
        masks: reader.masks(n, k)?,
        networks: RenderNetworks {
            opacity: reader.network("opacity")?,
            covariance: reader.network("covariance")?,
            color: reader.network("color")?,
        },
        near: metadata.near,
        scene_scale: metadata.scene_scale,
        frame: metadata.frame,
    };
    reader.finish()?;
    scene.check().map_err(|error| AnchorFileError::Scene(error.to_string()))?;
    Ok(AnchorFile { scene, background: metadata.background, dataset: metadata.dataset })
}

fn networks(networks: &RenderNetworks) -> [(&'static str, &Mlp); 3] {
    [("opacity", &networks.opacity), ("covariance", &networks.covariance), ("color", &networks.color)]
}

/// Takes tensors out of a file and counts them, so that none is overlooked.
struct Reader<'a> {
    tensors: SafeTensors<'a>,
    taken: usize,
}

impl<'a> Reader<'a> {
    fn tensor(&self, name: &str) -> Result<TensorView<'a>, AnchorFileError> {
        self.tensors.tensor(name).map_err(|_| tensor_error(name, "is missing"))
    }

    /// The shape of a tensor, whose sides must be those of `wanted` where it names one.
    fn shape<const R: usize>(
        &self,
        name: &str,
        wanted: [Option<usize>; R],
    ) -> Result<[usize; R], AnchorFileError> {
        let tensor = self.tensor(name)?;
        let shape: [usize; R] = tensor
            .shape()
            .try_into()
            .map_err(|_| tensor_error(name, format!("has shape {:?}, not {R} sides", tensor.shape())))?;
        for (side, (actual, wanted)) in shape.iter().zip(wanted).enumerate() {
            if let Some(wanted) = wanted
                && *actual != wanted
            {
                return Err(tensor_error(
                    name,
                    format!("has {actual} along side {side} where {wanted} are needed"),
                ));
            }
        }
        Ok(shape)
    }

    fn words(
        &mut self,
        name: &str,
        dtype: Dtype,
    ) -> Result<impl Iterator<Item = [u8; 4]> + use<'a>, AnchorFileError> {
        let bytes = self.bytes(name, dtype)?;
        Ok(bytes.chunks_exact(4).map(|word| [word[0], word[1], word[2], word[3]]))
    }

    fn floats(&mut self, name: &str) -> Result<Vec<f32>, AnchorFileError> {
        Ok(self.words(name, Dtype::F32)?.map(f32::from_le_bytes).collect())
    }

    /// The `[n][k]` masks, all on if there are none.
    fn masks(&mut self, n: usize, k: usize) -> Result<Vec<bool>, AnchorFileError> {
        if self.tensors.tensor("masks").is_err() {
            // As many as there are offsets, whose bytes are in the file.
            return Ok(vec![true; n * k]);
        }
        self.shape("masks", [Some(n), Some(k)])?;
        Ok(self.bytes("masks", Dtype::BOOL)?.iter().map(|byte| *byte != 0).collect())
    }

    fn bytes(&mut self, name: &str, dtype: Dtype) -> Result<&'a [u8], AnchorFileError> {
        let tensor = self.tensor(name)?;
        if tensor.dtype() != dtype {
            return Err(tensor_error(name, format!("is of type {:?}, not {dtype:?}", tensor.dtype())));
        }
        self.taken += 1;
        Ok(tensor.data())
    }

    fn network(&mut self, network: &str) -> Result<Mlp, AnchorFileError> {
        let mut layers = Vec::new();
        for index in 0..MAX_LAYERS {
            let (weight, bias) = (format!("{network}.{index}.weight"), format!("{network}.{index}.bias"));
            if index > 0 && self.tensors.tensor(&weight).is_err() {
                break;
            }
            let [outputs, inputs] = self.shape(&weight, [None, None])?;
            self.shape(&bias, [Some(outputs)])?;
            layers.push(DenseLayer {
                inputs,
                outputs,
                weights: self.floats(&weight)?,
                bias: self.floats(&bias)?,
            });
        }
        Ok(Mlp { layers })
    }

    fn finish(self) -> Result<(), AnchorFileError> {
        let total = self.tensors.len();
        if total == self.taken {
            return Ok(());
        }
        let unknown = total - self.taken;
        Err(AnchorFileError::Scene(format!("{unknown} of {total} tensors do not belong to a scene")))
    }
}

fn tensor_error(name: &str, problem: impl Into<String>) -> AnchorFileError {
    AnchorFileError::Tensor { name: name.to_owned(), problem: problem.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(inputs: usize, outputs: usize) -> DenseLayer {
        let weights = (0..inputs * outputs).map(|index| index as f32 * 0.25 - 1.0).collect();
        DenseLayer { inputs, outputs, weights, bias: vec![0.5; outputs] }
    }

    fn scene() -> AnchorScene {
        let mlp = |outputs| Mlp { layers: vec![layer(6, 2), layer(2, outputs)] };
        AnchorScene {
            lattice: Lattice { voxel: 0.01, origin: [1.0, -2.0, 0.1] },
            cells: vec![[-1, 2, 3], [4, 5, -6], [7, 8, 9]],
            feature_dim: 2,
            offsets_per_anchor: 2,
            features: (0..6).map(|value| value as f32 / 3.0).collect(),
            scalings: vec![0.125; 18],
            offsets: (0..18).map(|value| value as f32 * 0.2).collect(),
            masks: vec![true, false, true, true, false, true],
            networks: RenderNetworks { opacity: mlp(2), covariance: mlp(14), color: mlp(6) },
            near: NearPlane::of_extent(1.0),
            scene_scale: SceneScale::DEFAULT,
            frame: SceneFrame::WORLD,
        }
    }

    #[test]
    fn a_scene_comes_back_bit_for_bit_and_its_bytes_are_always_the_same() {
        for dataset in [None, Some(Digest::of(b"photographs"))] {
            let bytes = write(&scene(), Background::White, dataset).expect("writes");
            let expected = AnchorFile { scene: scene(), background: Background::White, dataset };
            assert_eq!(read(&bytes).expect("reads"), expected);
            for _ in 0..8 {
                assert!(
                    bytes == write(&scene(), Background::White, dataset).expect("writes"),
                    "the bytes vary"
                );
            }
        }
    }

    #[test]
    fn a_distance_unit_makes_a_file_that_programs_without_one_refuse() {
        let scene_scale = SceneScale::new(0.004).expect("a length");
        let scene = AnchorScene { scene_scale, ..scene() };
        let bytes = write(&scene, Background::White, None).expect("writes");
        assert_eq!(read(&bytes).expect("reads").scene, scene);
        // The length of the header is no text and comes before it.
        let text = |bytes: &[u8]| {
            let length = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"));
            String::from_utf8(bytes[8..8 + length as usize].to_vec()).expect("text")
        };
        let usual = text(&write(&self::scene(), Background::White, None).expect("writes"));
        assert!(usual.contains(r#"\"version\":1"#) && !usual.contains("unit"), "{usual}");

        let key = |name: &str| {
            let key = format!(r#"\"{name}\":"#);
            8 + text(&bytes).find(&key).expect("stated") + key.len()
        };
        let from = key("unit");
        let to = from + text(&bytes)[from - 8..].find(['}', ',']).expect("an end");
        for hostile in ["0", "-1", "1e-45", "1e39", "3e38", "null"] {
            let mut bytes = bytes.clone();
            bytes[from..to].copy_from_slice(format!("{hostile:>width$}", width = to - from).as_bytes());
            let error = read(&bytes).expect_err("refused").to_string();
            assert!(error.contains("cannot be read"), "{hostile}: {error}");
        }
        let mut later = bytes.clone();
        assert_eq!(later[key("version")], b'2');
        later[key("version")] = b'5';
        assert!(read(&later).expect_err("refused").to_string().contains("has version 5, not 1 to 4"));
    }

    #[test]
    fn harmonics_of_the_view_direction_make_a_file_that_programs_without_them_refuse() {
        for view_degree in [2, 3].map(|degree| ViewDegree::new(degree).expect("a degree")) {
            let mut scene = scene();
            let inputs = scene.feature_dim + view_degree.inputs();
            let RenderNetworks { opacity, covariance, color } = &mut scene.networks;
            for DenseLayer { inputs: of_layer, outputs, weights, .. } in
                [opacity, covariance, color].map(|mlp| &mut mlp.layers[0])
            {
                (*of_layer, *weights) = (inputs, (0..inputs * *outputs).map(|index| index as f32).collect());
            }
            let bytes = write(&scene, Background::White, None).expect("writes");
            assert_eq!(read(&bytes).expect("reads").scene, scene);
            let stated = r#"\"version\":4"#;
            assert!(bytes.windows(stated.len()).any(|window| window == stated.as_bytes()));
        }
    }

    #[test]
    fn a_frame_makes_a_file_that_programs_without_one_refuse() {
        let frame = SceneFrame::new([5e5, -4e6, 0.5].into(), 1.25).expect("a frame");
        let scene = AnchorScene { frame, ..scene() };
        let bytes = write(&scene, Background::White, None).expect("writes");
        assert_eq!(read(&bytes).expect("reads").scene, scene);
        let behind = |text: &str| {
            let found = bytes.windows(text.len()).position(|window| window == text.as_bytes());
            found.map(|at| at + text.len())
        };
        assert!(behind(r#"\"version\":3"#).is_some());
        let at = behind(r#"\"scale\":1.25"#).expect("stated") - 4;
        for hostile in ["0.00", "-1.0", "null"] {
            let mut bytes = bytes.clone();
            bytes[at..at + 4].copy_from_slice(hostile.as_bytes());
            let error = read(&bytes).expect_err("refused").to_string();
            assert!(error.contains("cannot be read"), "{hostile}: {error}");
        }
    }

    #[test]
    fn a_scene_without_masks_pays_for_none_and_every_byte_is_counted() {
        let masked = write(&scene(), Background::Black, None).expect("writes");
        let counts = byte_counts(&scene(), masked.len() as u64);
        assert_eq!(
            [counts.positions, counts.masks, counts.features, counts.scalings, counts.offsets],
            [36, 6, 24, 72, 72]
        );
        let networks = &scene().networks;
        let parameters =
            networks.opacity.parameters() + networks.covariance.parameters() + networks.color.parameters();
        assert_eq!(counts.networks, 4 * parameters as u64);
        let mut whole = scene();
        whole.masks.fill(true);
        let bytes = write(&whole, Background::Black, None).expect("writes");
        assert_eq!(read(&bytes).expect("reads").scene, whole);
        let counts = byte_counts(&whole, bytes.len() as u64);
        assert_eq!(counts.masks, 0);
        let ByteCounts { total, positions, networks, planes, features, scalings, offsets, container, .. } =
            counts;
        assert_eq!(total, bytes.len() as u64);
        assert_eq!(total, positions + networks + planes + features + scalings + offsets + container);
        let header = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"));
        assert_eq!(container, 8 + header + 16, "the header and the lattice");
    }

    #[test]
    fn every_truncation_and_a_wrong_scene_are_refused() {
        let bytes = write(&scene(), Background::Black, None).expect("writes");
        for length in 0..bytes.len() {
            assert!(read(&bytes[..length]).is_err(), "cut to {length}");
        }
        let mut nan = scene();
        nan.features[3] = f32::NAN;
        let error = read(&write(&nan, Background::Black, None).expect("writes")).expect_err("refused");
        assert_eq!(error, AnchorFileError::Scene("inconsistent scene: features[3] is not finite".to_owned()));
    }

    #[test]
    fn widths_that_no_size_can_be_computed_with_are_refused() {
        for (feature_dim, offsets_per_anchor) in [(usize::MAX, 2), (2, usize::MAX), (usize::MAX - 3, 2)] {
            let empty = AnchorScene {
                feature_dim,
                offsets_per_anchor,
                cells: Vec::new(),
                features: Vec::new(),
                scalings: Vec::new(),
                offsets: Vec::new(),
                masks: Vec::new(),
                ..scene()
            };
            let bytes = write(&empty, Background::Black, None).expect("writes");
            let error = read(&bytes).expect_err("refused").to_string();
            assert!(error.contains("are more than 65536"), "{error}");
        }
    }

    #[test]
    fn files_of_other_programs_are_refused_with_what_is_missing() {
        let values = 1.0_f32.to_le_bytes();
        let view = TensorView::new(Dtype::F32, vec![1], &values).expect("a tensor");
        let plain = safetensors::serialize([("w", view.clone())], None).expect("a file");
        assert!(read(&plain).expect_err("refused").to_string().contains("'tcgs' is missing"));
        let metadata =
            HashMap::from([("tcgs".to_owned(), r#"{"version":1,"background":"black"}"#.to_owned())]);
        let marked = safetensors::serialize([("w", view)], Some(metadata)).expect("a file");
        assert_eq!(read(&marked).expect_err("refused").to_string(), "tensor 'cells' is missing");
        let mut extra = scene();
        extra.networks.color.layers.push(layer(6, 6));
        extra.networks.color.layers[1] = layer(2, 6);
        let bytes = write(&extra, Background::Black, None).expect("writes");
        assert_eq!(read(&bytes).expect("a third layer is allowed").scene, extra);
    }
}
