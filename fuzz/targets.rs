//! What is fuzzed. Each function takes any bytes and panics where a promise of the codec is broken; a test of the
//! project runs them on the committed corpus with the ordinary compiler.

use tcgs_codec::{
    self as codec, DecodeError, DecodeLimits, EncodeSettings, Provenance,
    context::robust_frame,
    domain::{
        AnchorScene, AttributeGroup, Background, ContextCandidates, ContextKind, DenseLayer, Digest, Lattice,
        Mlp, NearPlane, PlaneContext, Planes, RenderNetworks, SceneFrame, SceneScale, UpLayer,
    },
};

use super::wire;

/// Small, so that a file cannot make a run slow by being allowed to be large.
const LIMITS: DecodeLimits = DecodeLimits {
    max_file_bytes: 1 << 20,
    max_anchors: 20_000,
    max_memory_bytes: 32 << 20,
    max_expansion: 4096,
};

/// Checksums that are mended, one after another, before a file is given up.
const MENDS: usize = 12;

/// `data` as a file, first as it is and then with its checksums made good one by one, so that every parser is reached.
pub(super) fn decode(data: &[u8]) {
    check(data);
    let mut bytes = data.to_vec();
    for _ in 0..MENDS {
        let error = check(&bytes);
        let mended = match error {
            Some(DecodeError::ChunkChecksum { stated, actual, .. }) => {
                replace(&mut bytes, &stated.to_le_bytes(), &actual.to_le_bytes())
            }
            Some(DecodeError::DecodeDigest { stated, actual }) => {
                replace(&mut bytes, stated.as_bytes(), actual.as_bytes())
            }
            Some(
                DecodeError::HeaderChecksum { .. }
                | DecodeError::FileLength { .. }
                | DecodeError::FileDigest { .. }
                | DecodeError::SectionChecksum { .. },
            ) => true,
            _ => return,
        };
        if !mended || !reseal(&mut bytes) {
            return;
        }
    }
}

/// `data` as descriptions of sections, put into a file whose checksums are good.
pub(super) fn decode_header(data: &[u8]) {
    const IDS: [[u8; 4]; 8] =
        [*b"MANI", *b"NETS", *b"CELL", *b"MASK", *b"ATTR", *b"CTXT", *b"PLAN", *b"NEW!"];
    let mut bytes = Bytes(data);
    let version = (u16::from(bytes.u8() != 255), u16::from(bytes.u8() / 128));
    let mut parts = Vec::new();
    while !bytes.0.is_empty() && parts.len() < 66 {
        let head = bytes.u8();
        let length = usize::from(bytes.u8());
        let length = if length == 255 { 4 * usize::from(bytes.u8()) } else { length };
        parts.push((IDS[usize::from(head % 8)], u32::from(head >> 3 & 3) ^ 1, bytes.take(length).to_vec()));
    }
    decode(&wire::file(version, &parts));
}

/// `data` as a scene: what is written is read back as it was, and written again it does not change.
pub(super) fn roundtrip(data: &[u8]) {
    let mut bytes = Bytes(data);
    let scene = scene(&mut bytes);
    let settings = EncodeSettings {
        feature_step: bytes.step(),
        scaling_step: bytes.step(),
        offset_step: bytes.step(),
        ..settings()
    };
    let candidates = (bytes.u8() & 1 == 1).then(|| candidates(&scene, &mut bytes));
    let Ok(encoded) = codec::encode(&scene, candidates.as_ref(), &settings) else { return };
    let decoded = codec::decode(&encoded.bytes, &DecodeLimits::default()).expect("what was written is read");
    assert_eq!(decoded.scene, encoded.scene);
    assert_eq!(decoded.decode_sha256, codec::decode_digest(&decoded.scene));
    if candidates.is_none() {
        let again = codec::encode(&decoded.scene, None, &settings).expect("what was read is written");
        assert_eq!(again.scene.features, decoded.scene.features);
        assert_eq!(again.scene.scalings, decoded.scene.scalings);
        assert_eq!(again.scene.offsets, decoded.scene.offsets);
        assert_eq!(again.scene.cells, decoded.scene.cells);
        assert_eq!(again.scene.masks, decoded.scene.masks);
    }
    decode(&encoded.bytes);
}

/// What must hold of any bytes; the error, where they are refused.
fn check(bytes: &[u8]) -> Option<DecodeError> {
    let inspected = codec::inspect(bytes);
    match codec::decode(bytes, &LIMITS) {
        Ok(decoded) => {
            assert_eq!(decoded.scene.check(), Ok(()));
            assert_eq!(decoded.scene.len(), decoded.manifest.anchors);
            assert_eq!(codec::decode_digest(&decoded.scene), decoded.manifest.decode_sha256);
            let counts = inspected.expect("what decodes is inspected").byte_counts;
            assert_eq!(counts.total, bytes.len() as u64);
            None
        }
        Err(error) => Some(error),
    }
}

/// States the length of `bytes` and makes good all checksums but those of chunks; false where there is no section table.
fn reseal(bytes: &mut [u8]) -> bool {
    if wire::table_end(bytes).is_none() {
        return false;
    }
    let length = bytes.len() as u64;
    bytes[16..24].copy_from_slice(&length.to_le_bytes());
    wire::reseal(bytes);
    true
}

/// Replaces the first occurrence.
fn replace(bytes: &mut [u8], from: &[u8], to: &[u8]) -> bool {
    let place = bytes.windows(from.len()).position(|window| window == from);
    place.is_some_and(|place| {
        bytes[place..place + to.len()].copy_from_slice(to);
        true
    })
}

/// Reads numbers off the front; zeros after the end.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn u8(&mut self) -> u8 {
        self.take(1).first().copied().unwrap_or(0)
    }

    fn take(&mut self, count: usize) -> &[u8] {
        let (taken, rest) = self.0.split_at(count.min(self.0.len()));
        self.0 = rest;
        taken
    }

    /// Mostly small numbers, at times any bits at all.
    fn f32(&mut self) -> f32 {
        match self.u8() {
            255 => f32::from_bits(u32::from_le_bytes([self.u8(), self.u8(), self.u8(), self.u8()])),
            byte => (f32::from(byte) - 128.0) / 16.0,
        }
    }

    fn step(&mut self) -> f32 {
        match self.u8() {
            0 => self.f32(),
            byte => f32::from(byte) / 64.0,
        }
    }

    fn floats(&mut self, count: usize) -> Vec<f32> {
        (0..count).map(|_| self.f32()).collect()
    }
}

fn scene(bytes: &mut Bytes<'_>) -> AnchorScene {
    let shape = bytes.u8();
    let (features, offsets) = (usize::from(shape & 3) + 1, usize::from(shape >> 2 & 3) + 1);
    let anchors = usize::from(bytes.u8() % 48) + 1;
    let spread = bytes.u8() % 24;
    let cell = |bytes: &mut Bytes<'_>| {
        [0; 3].map(|_: i32| (i32::from(bytes.u8() as i8) << spread).wrapping_add(i32::from(bytes.u8())))
    };
    let layer = |inputs: usize, outputs: usize, bytes: &mut Bytes<'_>| DenseLayer {
        inputs,
        outputs,
        weights: bytes.floats(inputs * outputs),
        bias: bytes.floats(outputs),
    };
    let mlp = |outputs, bytes: &mut Bytes<'_>| match bytes.u8() % 2 {
        0 => Mlp { layers: vec![layer(features + 4, outputs, bytes)] },
        _ => Mlp { layers: vec![layer(features + 4, 3, bytes), layer(3, outputs, bytes)] },
    };
    AnchorScene {
        near: NearPlane::DEFAULT,
        scene_scale: SceneScale::DEFAULT,
        frame: SceneFrame::WORLD,
        lattice: Lattice { voxel: bytes.step(), origin: [bytes.f32(), bytes.f32(), bytes.f32()] },
        cells: (0..anchors).map(|_| cell(bytes)).collect(),
        feature_dim: features,
        offsets_per_anchor: offsets,
        features: bytes.floats(anchors * features),
        scalings: bytes.floats(anchors * 6).iter().map(|value| value.abs()).collect(),
        offsets: bytes.floats(anchors * offsets * 3),
        masks: (0..anchors * offsets).map(|_| bytes.u8() & 3 > 0).collect(),
        networks: RenderNetworks {
            opacity: mlp(offsets, bytes),
            covariance: mlp(7 * offsets, bytes),
            color: mlp(3 * offsets, bytes),
        },
    }
}

/// Networks of every kind, and planes to sample, with weights that repeat a few of the input's numbers.
fn candidates(scene: &AnchorScene, bytes: &mut Bytes<'_>) -> ContextCandidates {
    let palette = bytes.floats(13);
    let repeat = |count: usize| -> Vec<f32> { (0..count).map(|index| palette[index * index % 13]).collect() };
    let shape = bytes.u8();
    let (edge, channels) = (usize::from(shape & 3) + 1, usize::from(shape >> 2 & 1) + 1);
    let layer = UpLayer { inputs: channels, outputs: 2, weights: repeat(18 * channels), bias: repeat(2) };
    let planes = Planes {
        edge,
        channels,
        latents: repeat(3 * channels * edge * edge),
        layers: if shape & 8 == 0 { Vec::new() } else { vec![layer] },
    };
    let layer = |inputs: usize, outputs: usize| DenseLayer {
        inputs,
        outputs,
        weights: repeat(inputs * outputs),
        bias: repeat(outputs),
    };
    let networks = |kind: ContextKind| {
        [scene.feature_dim, 6, 3 * scene.offsets_per_anchor].map(|channels| {
            let (inputs, outputs) = (kind.inputs(planes.plane_channels()), AttributeGroup::outputs(channels));
            Some(Mlp { layers: vec![layer(inputs, 3), layer(3, outputs)] })
        })
    };
    ContextCandidates {
        frame: robust_frame(&scene.cells),
        static_steps: [bytes.f32(), bytes.f32(), bytes.f32()],
        position: networks(ContextKind::Position),
        planes: vec![PlaneContext {
            own: networks(ContextKind::TriPlane),
            neighbors: networks(ContextKind::TriPlaneKnn),
            planes: planes.clone(),
        }],
    }
}

fn settings() -> EncodeSettings {
    EncodeSettings {
        background: Background::Black,
        feature_step: 1.0,
        scaling_step: 0.05,
        offset_step: 0.2,
        context: Default::default(),
        provenance: Provenance {
            generator: "fuzz".to_owned(),
            dataset: Some(Digest::of(b"fuzz")),
            adapter: None,
            settings: serde_json::Value::Null,
        },
    }
}
