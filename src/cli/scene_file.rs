//! Decoded attributes as a safetensors file, which every tensor library reads, and back without a loss.
//!
//! Tensors, with N anchors, F features and K offsets an anchor: `cells` i32 `[N, 3]`, `features` f32 `[N, F]`,
//! `scalings` f32 `[N, 6]` (linear), `offsets` f32 `[N, K, 3]`, `masks` bool `[N, K]`, `lattice.voxel` f32 `[1]`,
//! `lattice.origin` f32 `[3]`, and for each network `opacity`, `covariance`, `color` and layer i:
//! `NETWORK.i.weight` f32 `[outputs, inputs]`, `NETWORK.i.bias` f32 `[outputs]`. An anchor's position is
//! `cells * voxel + origin`. The metadata key `tcgs` holds a JSON object with `version` and `background`.

use std::collections::HashMap;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use tcgs::domain::{AnchorScene, Background, DenseLayer, Lattice, Mlp, RenderNetworks};
use thiserror::Error;

/// Version of this layout of tensors.
const VERSION: u32 = 1;

/// More layers than any network of this program has; a bound on what a file may claim.
const MAX_LAYERS: usize = 16;

/// Why a safetensors file is not a scene.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub(crate) enum SceneFileError {
    /// The file is not safetensors.
    #[error("not a safetensors file: {0}")]
    Format(String),
    /// The metadata are not those that `tcgs decode` writes.
    #[error("the metadata key 'tcgs' {0}; this reads files that `tcgs decode` wrote")]
    Metadata(String),
    /// A tensor is missing, of another type, or of another shape.
    #[error("tensor '{name}' {fault}")]
    Tensor {
        /// Its name.
        name: String,
        /// What is wrong.
        fault: String,
    },
    /// The tensors do not fit together.
    #[error("{0}")]
    Scene(String),
}

#[derive(Debug, Serialize, Deserialize)]
struct Metadata {
    version: u32,
    background: Background,
}

/// The scene as the bytes of a safetensors file; the same scene gives the same bytes.
pub(crate) fn to_bytes(scene: &AnchorScene, background: Background) -> Result<Vec<u8>, SceneFileError> {
    let (n, f, k) = (scene.len(), scene.feature_dim, scene.offsets_per_anchor);
    let cells = scene.cells.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let masks = scene.masks.iter().map(|kept| u8::from(*kept)).collect();
    let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = vec![
        ("cells".to_owned(), Dtype::I32, vec![n, 3], cells),
        ("masks".to_owned(), Dtype::BOOL, vec![n, k], masks),
    ];
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
        .map_err(|fault| SceneFileError::Scene(fault.to_string()))?;
    // One key: several would be written in the random order of a hash map.
    let metadata = serde_json::to_string(&Metadata { version: VERSION, background })
        .map_err(|fault| SceneFileError::Scene(fault.to_string()))?;
    safetensors::serialize(views, Some(HashMap::from([("tcgs".to_owned(), metadata)])))
        .map_err(|fault| SceneFileError::Scene(fault.to_string()))
}

/// The scene in the bytes of a safetensors file, checked, with the background that it was trained on.
pub(crate) fn from_bytes(bytes: &[u8]) -> Result<(AnchorScene, Background), SceneFileError> {
    let format = |fault: safetensors::SafeTensorError| SceneFileError::Format(fault.to_string());
    let tensors = SafeTensors::deserialize(bytes).map_err(format)?;
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
    let text = header
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get("tcgs"))
        .ok_or_else(|| SceneFileError::Metadata("is missing".to_owned()))?;
    let metadata: Metadata = serde_json::from_str(text)
        .map_err(|fault| SceneFileError::Metadata(format!("cannot be read ({fault})")))?;
    if metadata.version != VERSION {
        return Err(SceneFileError::Metadata(format!("has version {}, not {VERSION}", metadata.version)));
    }

    let mut reader = Reader { tensors, taken: 0 };
    let [n, _] = reader.shape("cells", [None, Some(3)])?;
    let [_, f] = reader.shape("features", [Some(n), None])?;
    let [_, k] = reader.shape("masks", [Some(n), None])?;
    reader.shape("scalings", [Some(n), Some(6)])?;
    reader.shape("offsets", [Some(n), Some(k), Some(3)])?;
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
        masks: reader.booleans("masks")?,
        networks: RenderNetworks {
            opacity: reader.network("opacity")?,
            covariance: reader.network("covariance")?,
            color: reader.network("color")?,
        },
    };
    reader.finish()?;
    scene.check().map_err(|fault| SceneFileError::Scene(fault.to_string()))?;
    Ok((scene, metadata.background))
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
    fn tensor(&self, name: &str) -> Result<TensorView<'a>, SceneFileError> {
        self.tensors.tensor(name).map_err(|_| fault(name, "is missing"))
    }

    /// The shape of a tensor, whose sides must be those of `wanted` where it names one.
    fn shape<const R: usize>(
        &self,
        name: &str,
        wanted: [Option<usize>; R],
    ) -> Result<[usize; R], SceneFileError> {
        let tensor = self.tensor(name)?;
        let shape: [usize; R] = tensor
            .shape()
            .try_into()
            .map_err(|_| fault(name, format!("has shape {:?}, not {R} sides", tensor.shape())))?;
        for (side, (actual, wanted)) in shape.iter().zip(wanted).enumerate() {
            if let Some(wanted) = wanted
                && *actual != wanted
            {
                return Err(fault(name, format!("has {actual} along side {side} where {wanted} are needed")));
            }
        }
        Ok(shape)
    }

    fn words(
        &mut self,
        name: &str,
        dtype: Dtype,
    ) -> Result<impl Iterator<Item = [u8; 4]> + use<'a>, SceneFileError> {
        let bytes = self.bytes(name, dtype)?;
        Ok(bytes.chunks_exact(4).map(|word| [word[0], word[1], word[2], word[3]]))
    }

    fn floats(&mut self, name: &str) -> Result<Vec<f32>, SceneFileError> {
        Ok(self.words(name, Dtype::F32)?.map(f32::from_le_bytes).collect())
    }

    fn booleans(&mut self, name: &str) -> Result<Vec<bool>, SceneFileError> {
        Ok(self.bytes(name, Dtype::BOOL)?.iter().map(|byte| *byte != 0).collect())
    }

    fn bytes(&mut self, name: &str, dtype: Dtype) -> Result<&'a [u8], SceneFileError> {
        let tensor = self.tensor(name)?;
        if tensor.dtype() != dtype {
            return Err(fault(name, format!("is of type {:?}, not {dtype:?}", tensor.dtype())));
        }
        self.taken += 1;
        Ok(tensor.data())
    }

    fn network(&mut self, network: &str) -> Result<Mlp, SceneFileError> {
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

    fn finish(self) -> Result<(), SceneFileError> {
        let total = self.tensors.len();
        if total == self.taken {
            return Ok(());
        }
        let unknown = total - self.taken;
        Err(SceneFileError::Scene(format!("{unknown} of {total} tensors do not belong to a scene")))
    }
}

fn fault(name: &str, fault: impl Into<String>) -> SceneFileError {
    SceneFileError::Tensor { name: name.to_owned(), fault: fault.into() }
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
        }
    }

    #[test]
    fn a_scene_comes_back_bit_for_bit_and_its_bytes_are_always_the_same() {
        let bytes = to_bytes(&scene(), Background::White).expect("writes");
        assert_eq!(from_bytes(&bytes).expect("reads"), (scene(), Background::White));
        for _ in 0..8 {
            assert!(bytes == to_bytes(&scene(), Background::White).expect("writes"), "the bytes vary");
        }
    }

    #[test]
    fn every_truncation_and_a_wrong_scene_are_refused() {
        let bytes = to_bytes(&scene(), Background::Black).expect("writes");
        for length in 0..bytes.len() {
            assert!(from_bytes(&bytes[..length]).is_err(), "cut to {length}");
        }
        let mut nan = scene();
        nan.features[3] = f32::NAN;
        let fault = from_bytes(&to_bytes(&nan, Background::Black).expect("writes")).expect_err("refused");
        assert_eq!(fault, SceneFileError::Scene("inconsistent scene: features[3] is not finite".to_owned()));
    }

    #[test]
    fn files_of_other_programs_are_refused_with_what_is_missing() {
        let values = 1.0_f32.to_le_bytes();
        let view = TensorView::new(Dtype::F32, vec![1], &values).expect("a tensor");
        let plain = safetensors::serialize([("w", view.clone())], None).expect("a file");
        assert!(from_bytes(&plain).expect_err("refused").to_string().contains("'tcgs' is missing"));
        let metadata =
            HashMap::from([("tcgs".to_owned(), r#"{"version":1,"background":"black"}"#.to_owned())]);
        let marked = safetensors::serialize([("w", view)], Some(metadata)).expect("a file");
        assert_eq!(from_bytes(&marked).expect_err("refused").to_string(), "tensor 'cells' is missing");
        let mut extra = scene();
        extra.networks.color.layers.push(layer(6, 6));
        extra.networks.color.layers[1] = layer(2, 6);
        let bytes = to_bytes(&extra, Background::Black).expect("writes");
        assert_eq!(from_bytes(&bytes).expect("a third layer is allowed").0, extra);
    }
}
