//! The sections of this version. The critical ones every file has: without any of them there is no scene.

use super::container::SectionId;

/// Counts, lattice, steps, provenance.
pub(super) const MANIFEST: SectionId = *b"MANI";
/// Render networks.
pub(super) const NETWORKS: SectionId = *b"NETS";
/// Anchor cells.
pub(super) const POSITIONS: SectionId = *b"CELL";
/// Which offsets make a Gaussian.
pub(super) const MASKS: SectionId = *b"MASK";
/// Features, scalings, offsets.
pub(super) const ATTRIBUTES: SectionId = *b"ATTR";

/// Where views begin: optional, for scenes that are not seen from the usual depth.
pub(super) const VIEW: SectionId = *b"VIEW";

/// The sections that every file has, all critical.
pub(super) const ALL: [SectionId; 5] = [MANIFEST, NETWORKS, POSITIONS, MASKS, ATTRIBUTES];

/// Every section that a decoder of this version understands.
pub(super) const KNOWN: [SectionId; 6] = [MANIFEST, NETWORKS, POSITIONS, MASKS, ATTRIBUTES, VIEW];

/// What a section holds, in words.
pub(super) fn name(id: SectionId) -> &'static str {
    match id {
        MANIFEST => "manifest",
        NETWORKS => "networks",
        POSITIONS => "positions",
        MASKS => "masks",
        ATTRIBUTES => "attributes",
        VIEW => "view",
        _ => "unknown",
    }
}
