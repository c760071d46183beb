//! Decodes a file into a scene: a pure function of the bytes, within limits that the caller sets.

use super::{
    alloc::check_limit,
    attributes,
    container::Container,
    context::{AnchorContext, BaseModel, GroupModel, GroupRegression, IntegerPlanes, Regressions, section},
    digest::decode_digest,
    error::{DecodeError, Result},
    manifest::Manifest,
    masks,
    networks::{self, QuantizedNetworks},
    positions,
    quantize::{self, Symbols},
    sections,
    shape::{Attribute, SceneShape},
    view,
};
use crate::domain::{
    AnchorScene, Digest, NearPlane, SceneFrame, SceneScale,
    anchors::SCALINGS_PER_ANCHOR,
    context_model::{ContextKind, NEIGHBORS},
};

/// Limits on the files that a caller accepts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DecodeLimits {
    /// Longest file in bytes.
    pub max_file_bytes: u64,
    /// Most anchors.
    pub max_anchors: u64,
    /// Most bytes that the anchors may take, and that the networks, the context's networks and its planes may take, each
    /// with the decoder's own arrays.
    pub max_memory_bytes: u64,
    /// Most bytes of memory that the anchors may take for each byte of the file, beyond the first 16 MiB: a few bytes can
    /// spell out millions of equal anchors.
    pub max_expansion: u64,
}

/// Bytes of memory that any file may take, however short it is.
const FREE_MEMORY_BYTES: u64 = 16 << 20;

impl DecodeLimits {
    /// No limits, for files from a trusted source.
    pub const NONE: Self = Self {
        max_file_bytes: u64::MAX,
        max_anchors: u64::MAX,
        max_memory_bytes: u64::MAX,
        max_expansion: u64::MAX,
    };
}

impl Default for DecodeLimits {
    /// 1 GiB of file, 10 million anchors, 8 GiB of memory, 4096 times the file: far above any scene that was trained to
    /// be sent, which takes some hundred times its file.
    fn default() -> Self {
        Self {
            max_file_bytes: 1 << 30,
            max_anchors: 10_000_000,
            max_memory_bytes: 8 << 30,
            max_expansion: 4096,
        }
    }
}

/// A file's content.
#[derive(Debug, Clone, PartialEq)]
pub struct Decoded {
    /// The scene, anchors in Morton order.
    pub scene: AnchorScene,
    /// Counts, choices and provenance.
    pub manifest: Manifest,
    /// SHA-256 of the scene, equal to the manifest's.
    pub decode_sha256: Digest,
}

/// Reads a `.tcgs` file.
///
/// # Errors
/// [`DecodeError`] for bytes that are not exactly one undamaged file of a known version within `limits`.
pub fn decode(bytes: &[u8], limits: &DecodeLimits) -> Result<Decoded> {
    decode_with(bytes, limits, None)
}

/// Neighbors of cells as the encoder found them. They depend on the cells alone, so decoding the same cells needs no second search.
pub(super) struct KnownNeighbors<'a> {
    pub(super) cells: &'a [[i32; 3]],
    /// Of each cell.
    pub(super) neighbors: Vec<[u32; NEIGHBORS]>,
}

/// As [`decode`], without a search for neighbors that are known.
pub(super) fn decode_with(
    bytes: &[u8],
    limits: &DecodeLimits,
    known: Option<KnownNeighbors<'_>>,
) -> Result<Decoded> {
    let _stage = tracing::debug_span!("decode").entered();
    let DecodedSections { manifest, networks, symbols, near, scene_scale, frame, .. } =
        read_with(bytes, limits, known)?;
    let scene =
        AnchorScene { near, scene_scale, frame, ..quantize::dequantize(symbols, &networks, &manifest) };
    let decode_sha256 = decode_digest(&scene);
    if decode_sha256 != manifest.decode_sha256 {
        return Err(DecodeError::DecodeDigest { stated: manifest.decode_sha256, actual: decode_sha256 });
    }
    Ok(Decoded { scene, manifest, decode_sha256 })
}

/// A file's integers with the models that predicted them.
pub(super) struct DecodedSections {
    pub(super) manifest: Manifest,
    pub(super) networks: QuantizedNetworks,
    pub(super) symbols: Symbols,
    pub(super) models: [GroupModel; 3],
    pub(super) anchors: AnchorContext,
    /// Near plane.
    pub(super) near: NearPlane,
    /// Unit of the distances that the render networks get.
    pub(super) scene_scale: SceneScale,
    /// Where the scene's coordinates are in the world.
    pub(super) frame: SceneFrame,
}

/// Reads everything as integers, without dequantizing.
pub(super) fn read(bytes: &[u8], limits: &DecodeLimits) -> Result<DecodedSections> {
    read_with(bytes, limits, None)
}

fn read_with(
    bytes: &[u8],
    limits: &DecodeLimits,
    known: Option<KnownNeighbors<'_>>,
) -> Result<DecodedSections> {
    let stage = tracing::Span::current();
    check_limit("file bytes", bytes.len() as u64, limits.max_file_bytes)?;
    let container = Container::parse(bytes)?;
    container.check_known(&sections::ALL)?;
    let manifest = Manifest::decode(container.section(sections::MANIFEST)?.bytes)?;
    check_limit("anchors", manifest.anchors as u64, limits.max_anchors)?;
    let memory = memory(&manifest);
    // No allocation is larger, so with this bound no product of counts overflows, even where `usize` has 32 bits.
    check_limit("bytes of memory", memory, limits.max_memory_bytes.min(isize::MAX as u64))?;
    let max_for_length =
        FREE_MEMORY_BYTES.saturating_add(limits.max_expansion.saturating_mul(bytes.len() as u64));
    check_limit("bytes of memory for a file of this length", memory, max_for_length)?;

    let (shape, k) = (manifest.shape(), manifest.offsets_per_anchor);
    let of_networks = container.section(sections::NETWORKS)?.bytes;
    let of_positions = container.section(sections::POSITIONS)?.bytes;
    let of_masks = container.section(sections::MASKS)?.bytes;
    let regressions = regressions(&container, shape)?;
    let view_degree = view::decode_view_degree(container.find(sections::DIRECTIONS))?;
    let inputs = manifest.feature_dim + view_degree.inputs();
    let networks = networks::decode(of_networks, inputs, k, limits.max_memory_bytes)?;
    if manifest.anchors as u64 >= positions::max_anchors_exclusive(of_positions.len()) {
        return Err(DecodeError::malformed(
            "positions",
            "number of anchors",
            format!("{} in {} bytes", manifest.anchors, of_positions.len()),
        ));
    }
    // Both are one long stream.
    let (cells, masks) = rayon::join(
        || stage.in_scope(|| positions::decode(of_positions, manifest.anchors)),
        || stage.in_scope(|| masks::decode(of_masks, manifest.anchors, k)),
    );
    let (cells, masks) = (cells?, masks?);
    let gaussians = masks.iter().filter(|kept| **kept).count();
    if gaussians != manifest.gaussians {
        return Err(DecodeError::malformed(
            "masks",
            "number of Gaussians",
            format!("{gaussians} where {} are stated", manifest.gaussians),
        ));
    }
    let (networks_of_groups, anchors) = context(&container, &manifest, &cells, limits, known)?;
    let section = container.section(sections::ATTRIBUTES)?.bytes;
    let mut layout =
        attributes::AttributeLayout::read(section, shape, manifest.chunk_anchors, manifest.kinds())?;
    let tables = std::mem::take(&mut layout.tables);
    let models = join(tables, networks_of_groups, regressions)?;
    let (groups, step_indices) = layout.decode(section, shape, &masks, models.each_ref(), &anchors)?;

    let symbols = Symbols { cells, masks, groups, step_indices };
    let near = view::decode_near(container.find(sections::VIEW))?;
    let scene_scale = view::decode_scene_scale(container.find(sections::UNIT))?;
    let frame = view::decode_frame(container.find(sections::FRAME))?;
    Ok(DecodedSections { manifest, networks, symbols, models, anchors, near, scene_scale, frame })
}

/// Most multiplications that a file's networks may take, and its regressions: 27 000 an anchor for ten million anchors. Anchors that are easily
/// predicted cost next to no bytes, so bytes alone would not bound the time.
pub(super) const MAX_MULTIPLICATIONS: u64 = 1 << 38;

/// The networks of the groups that have one, and their inputs for each anchor.
fn context(
    container: &Container<'_>,
    manifest: &Manifest,
    cells: &[[i32; 3]],
    limits: &DecodeLimits,
    known: Option<KnownNeighbors<'_>>,
) -> Result<([Option<BaseModel>; 3], AnchorContext)> {
    let kinds = manifest.kinds();
    let any = |wanted: fn(ContextKind) -> bool| kinds.iter().flatten().any(|kind| wanted(*kind));
    let samples = any(|kind| kind.sampled() > 0);
    let neighbors = any(|kind| kind.sampled() > 1);
    let context = container.section_if(any(|_| true), sections::CONTEXT)?;
    let planes = container.section_if(samples, sections::PLANES)?;
    let Some(context) = context else { return Ok(([None, None, None], AnchorContext::default())) };

    let _stage = tracing::debug_span!("context").entered();
    let layout = section::Layout::read(context.bytes, kinds)?;
    let planes =
        planes.map(|planes| IntegerPlanes::decode(planes.bytes, limits.max_memory_bytes)).transpose()?;
    let channels = planes.as_ref().map_or(0, IntegerPlanes::plane_channels);
    let shape = manifest.shape();
    let widths = Attribute::ALL.map(|attribute| shape.channels(attribute));
    let networks = layout.networks(context.bytes, kinds, channels, widths, limits.max_memory_bytes)?;
    let work: u64 = networks.iter().flatten().map(|network| network.mlp.multiplications()).sum();
    let work = work.saturating_mul(cells.len() as u64);
    if work > MAX_MULTIPLICATIONS {
        let (part, what) = ("context", "multiplications for all anchors");
        return Err(DecodeError::malformed(part, what, work));
    }
    let memory = cells.len() as u64 * AnchorContext::bytes_per_anchor(channels, neighbors);
    check_limit("bytes of memory for the context", memory, limits.max_memory_bytes)?;

    let mut anchors = AnchorContext::new(&layout.frame, cells);
    if let Some(planes) = planes {
        anchors.sample(&planes.texels());
    }
    if neighbors {
        match known.filter(|known| known.cells == cells && known.neighbors.len() == cells.len()) {
            Some(known) => anchors.set_neighbors(known.neighbors),
            None => anchors.find_neighbors(cells),
        }
    }
    Ok((networks.map(|network| network.map(BaseModel::Network)), anchors))
}

/// The regressions of the groups that have one.
fn regressions(container: &Container<'_>, shape: SceneShape) -> Result<[Option<GroupRegression>; 3]> {
    let Some(section) = container.find(sections::REGRESSION) else { return Ok([None, None, None]) };
    let widths = Attribute::ALL.map(|attribute| shape.channels(attribute));
    let groups = Regressions::read(section.bytes, widths)?.groups;
    let with = widths.into_iter().zip(&groups).filter(|(_, regression)| regression.is_some());
    let work: u64 = with.map(|(channels, _)| GroupRegression::multiplications(channels)).sum();
    let work = work.saturating_mul(shape.anchors as u64);
    if work > MAX_MULTIPLICATIONS {
        return Err(DecodeError::malformed("regression", "multiplications for all anchors", work));
    }
    Ok(groups)
}

/// One model a group: its tables or its network, and its regression.
fn join(
    tables: [Option<BaseModel>; 3],
    networks: [Option<BaseModel>; 3],
    regressions: [Option<GroupRegression>; 3],
) -> Result<[GroupModel; 3]> {
    let bases = tables.into_iter().zip(networks).filter_map(|(tables, network)| tables.or(network));
    let mut models = bases.zip(regressions).map(|(base, regression)| GroupModel { base, regression });
    match [models.next(), models.next(), models.next()] {
        [Some(features), Some(scalings), Some(offsets)] => Ok([features, scalings, offsets]),
        _ => Err(DecodeError::MissingSection { section: "context" }),
    }
}

/// Bytes that decoding takes at its peak: integers, step indices and floats of the attributes, a mask byte an
/// offset, cells, and two levels of the octree with a code, six neighbors and a family a node.
fn memory(manifest: &Manifest) -> u64 {
    let values = manifest.feature_dim + SCALINGS_PER_ANCHOR + 3 * manifest.offsets_per_anchor;
    let anchor = 2 * 4 * values + 3 + manifest.offsets_per_anchor + 12 + 2 * 40;
    manifest.anchors as u64 * anchor as u64
}
