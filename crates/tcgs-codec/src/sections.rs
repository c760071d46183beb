//! The sections of this version. A decoder must understand the critical ones.

/// Four ASCII characters.
pub(super) type SectionId = [u8; 4];

/// Counts, lattice, steps, contexts, provenance.
pub(super) const MANIFEST: SectionId = *b"MANI";
/// Render networks.
pub(super) const NETWORKS: SectionId = *b"NETS";
/// Anchor cells.
pub(super) const POSITIONS: SectionId = *b"CELL";
/// Which offsets make a Gaussian.
pub(super) const MASKS: SectionId = *b"MASK";
/// Frame and networks of the context model, if a group has one.
pub(super) const CONTEXT: SectionId = *b"CTXT";
/// Planes of the context model, if a network samples them.
pub(super) const PLANES: SectionId = *b"PLAN";
/// How channels follow from the anchor's earlier ones, if a group's do.
pub(super) const REGRESSION: SectionId = *b"REGR";
/// Features, scalings, offsets.
pub(super) const ATTRIBUTES: SectionId = *b"ATTR";

/// Unit of the distances that the render networks get, if it is not that of the scene's frame.
pub(super) const UNIT: SectionId = *b"UNIT";
/// Frame of the scene, if it is not the world's.
pub(super) const FRAME: SectionId = *b"FRAM";
/// How the networks see the direction of view, if not as a unit vector alone.
pub(super) const DIRECTIONS: SectionId = *b"DIRS";
/// Near plane, if it is not the default.
pub(super) const VIEW: SectionId = *b"VIEW";

/// Every section that a decoder of this version understands.
pub(super) const ALL: [SectionId; 12] = [
    MANIFEST, NETWORKS, POSITIONS, MASKS, CONTEXT, PLANES, REGRESSION, ATTRIBUTES, UNIT, FRAME, DIRECTIONS,
    VIEW,
];

/// Those that every file has.
pub(super) const ALWAYS: [SectionId; 5] = [MANIFEST, NETWORKS, POSITIONS, MASKS, ATTRIBUTES];

/// Name of a section.
pub(super) fn name(id: SectionId) -> &'static str {
    match id {
        MANIFEST => "manifest",
        NETWORKS => "networks",
        POSITIONS => "positions",
        MASKS => "masks",
        CONTEXT => "context",
        PLANES => "planes",
        REGRESSION => "regression",
        ATTRIBUTES => "attributes",
        UNIT => "unit",
        FRAME => "frame",
        DIRECTIONS => "directions",
        VIEW => "view",
        _ => "unknown",
    }
}
