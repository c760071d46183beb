//! Where each byte of a file goes, without decoding the payload.
//!
//! The ranges of an [`Inspection`] tile the file: they start at byte 0, leave no gap and end at its length.

use std::{fmt, ops::Range};

use serde::{Deserialize, Serialize};

use super::{
    attributes::AttributeLayout,
    container::{ARITHMETIC_PROFILE, Container, FIXED_HEADER, Section, id_text},
    context::{Regressions, section},
    error::Result,
    explain::explain,
    manifest::{GroupCosts, Manifest},
    sections,
    shape::Attribute,
    view,
};
use crate::domain::{
    ByteCounts, Digest, SceneFrame, SceneScale, choices::Explanation, context_model::ContextKind,
};

/// Purpose of a byte range; the groups of [`ByteCounts`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ByteGroup {
    /// Header, section table, manifest, chunk index, sections that this version does not know.
    Container,
    /// Anchor cells.
    Positions,
    /// Render networks, networks and regressions of the context.
    Networks,
    /// Planes of the context.
    Planes,
    /// Offset masks.
    Masks,
    /// Anchor features.
    Features,
    /// Anchor scalings.
    Scalings,
    /// Offsets.
    Offsets,
}

impl fmt::Display for ByteGroup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// A run of bytes with one purpose.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ByteRange {
    /// First byte in the file.
    pub offset: u64,
    /// Number of bytes.
    pub length: u64,
    /// Purpose, as counted.
    pub group: ByteGroup,
    /// Purpose, in words.
    pub what: String,
}

/// A section of the file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SectionReport {
    /// Four characters.
    pub id: String,
    /// Name of the content; `unknown` for an optional section of a later version.
    pub name: String,
    /// Whether a decoder must understand it.
    pub critical: bool,
    /// First byte in the file.
    pub offset: u64,
    /// Number of bytes.
    pub length: u64,
}

/// The structure of a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Inspection {
    /// Format version as `major.minor`.
    pub version: String,
    /// Arithmetic profile.
    pub profile: u16,
    /// SHA-256 stated in the header and verified: of the whole file but this hash and the header checksum.
    pub content_sha256: Digest,
    /// Counts, choices and provenance.
    pub manifest: Manifest,
    /// Bytes of the groups that have a regression, counted as the manifest counts the alternatives: attributes, regression and network.
    pub regressions: [Option<u64>; 3],
    /// What the run chose and why, for people.
    pub choices: Vec<Explanation>,
    /// Where the scene's coordinates are in the world: `world = offset + scale * coordinate`. Lattice and steps are in its units.
    pub frame: SceneFrame,
    /// Unit of the distances that the networks get, in units of the frame.
    #[serde(rename = "distance_unit")]
    pub scene_scale: SceneScale,
    /// Highest degree of the view direction's spherical harmonics that the networks get.
    pub view_degree: u8,
    /// Sections in file order.
    pub sections: Vec<SectionReport>,
    /// Every byte of the file, in order.
    pub ranges: Vec<ByteRange>,
    /// The ranges summed by group.
    pub byte_counts: ByteCounts,
}

/// Checks a file's container and lists its parts.
///
/// # Errors
/// [`super::DecodeError`] as [`super::decode`] gives it for the container, the manifest and the chunk index; the coded
/// payload is not read.
pub fn inspect(bytes: &[u8]) -> Result<Inspection> {
    let container = Container::parse(bytes)?;
    container.check_known(&sections::ALL)?;
    let manifest = Manifest::decode(container.section(sections::MANIFEST)?.bytes)?;
    for id in sections::ALWAYS {
        container.section(id)?;
    }
    let kinds = || manifest.kinds().into_iter().flatten();
    container.section_if(kinds().next().is_some(), sections::CONTEXT)?;
    container.section_if(kinds().any(|kind| kind.sampled() > 0), sections::PLANES)?;

    let mut map = Map::default();
    map.push(FIXED_HEADER, ByteGroup::Container, "header: signature, version, length, SHA-256, checksum");
    let table =
        container.sections.first().map_or(bytes.len(), |section| section.offset as usize) - FIXED_HEADER;
    map.push(table, ByteGroup::Container, "section table");
    for section in &container.sections {
        map_section(section, &manifest, &mut map)?;
    }

    let regressions = regression_bytes(&container, &manifest, &map)?;
    let report = |section: &Section<'_>| SectionReport {
        id: id_text(section.id),
        name: sections::name(section.id).to_owned(),
        critical: section.critical,
        offset: section.offset,
        length: section.bytes.len() as u64,
    };
    let frame = view::decode_frame(container.find(sections::FRAME))?;
    Ok(Inspection {
        version: format!("{}.{}", container.version.0, container.version.1),
        profile: ARITHMETIC_PROFILE,
        content_sha256: container.digest,
        choices: explain(&manifest, regressions, frame),
        manifest,
        regressions,
        frame,
        scene_scale: view::decode_scene_scale(container.find(sections::UNIT))?,
        view_degree: view::decode_view_degree(container.find(sections::DIRECTIONS))?.get(),
        sections: container.sections.iter().map(report).collect(),
        byte_counts: count(&map.ranges),
        ranges: map.ranges,
    })
}

/// Bytes of attributes, regression and network of each group that has a regression.
fn regression_bytes(container: &Container<'_>, manifest: &Manifest, map: &Map) -> Result<[Option<u64>; 3]> {
    let Some(section) = container.find(sections::REGRESSION) else { return Ok([None; 3]) };
    let shape = manifest.shape();
    let read = Regressions::read(section.bytes, Attribute::ALL.map(|group| shape.channels(group)))?;
    let networks = match container.find(sections::CONTEXT) {
        Some(context) => section::Layout::read(context.bytes, manifest.kinds())?.places,
        None => [0..0, 0..0, 0..0],
    };
    Ok(Attribute::ALL.map(|attribute| {
        let own = map.ranges.iter().filter(|range| range.group == group(attribute));
        let number = attribute as usize;
        let model = (networks[number].len() + read.lengths[number]) as u64;
        let bytes = own.map(|range| range.length).sum::<u64>() + model;
        read.groups[number].as_ref().map(|_| bytes)
    }))
}

fn map_section(section: &Section<'_>, manifest: &Manifest, map: &mut Map) -> Result<()> {
    let length = section.bytes.len();
    match section.id {
        sections::MANIFEST => {
            map.push(length, ByteGroup::Container, "manifest: counts, lattice, steps, contexts, provenance")
        }
        sections::NETWORKS => map.push(length, ByteGroup::Networks, "opacity, covariance and color network"),
        sections::POSITIONS => map.push(length, ByteGroup::Positions, "occupancy octree of the anchor cells"),
        sections::MASKS => map.push(length, ByteGroup::Masks, "which offsets make a Gaussian"),
        sections::CONTEXT => {
            let layout = section::Layout::read(section.bytes, manifest.kinds())?;
            map.push(layout.frame_place.len(), ByteGroup::Networks, "frame of the context's planes");
            for (group, place) in ["features", "scalings", "offsets"].iter().zip(&layout.places) {
                if !place.is_empty() {
                    map.push(place.len(), ByteGroup::Networks, &format!("context network of the {group}"));
                }
            }
        }
        sections::PLANES => {
            map.push(length, ByteGroup::Planes, "latents and up-sampling layers of the planes")
        }
        sections::REGRESSION => {
            let widths = Attribute::ALL.map(|attribute| manifest.shape().channels(attribute));
            let lengths = Regressions::read(section.bytes, widths)?.lengths;
            map.push(Regressions::FLAGS_BYTES, ByteGroup::Container, "which groups have a regression");
            for (group, length) in ["features", "scalings", "offsets"].iter().zip(lengths) {
                if length > 0 {
                    map.push(length, ByteGroup::Networks, &format!("regression of the {group}"));
                }
            }
        }
        sections::ATTRIBUTES => {
            let (shape, kinds) = (manifest.shape(), manifest.kinds());
            let layout = AttributeLayout::read(section.bytes, shape, manifest.chunk_anchors, kinds)?;
            for attribute in Attribute::ALL {
                let place = attribute.of(&layout.parameters);
                if !place.is_empty() {
                    map.push(place.len(), group(attribute), "step, means and scales of the channels");
                }
            }
            map.push(layout.index.len(), ByteGroup::Container, "chunk index: lengths and checksums");
            for (number, chunk) in layout.chunks.iter().enumerate() {
                for attribute in Attribute::ALL {
                    let Range { start, end } = chunk.anchors;
                    let what = format!("chunk {number}, anchors {start}..{end}");
                    map.push(attribute.of(&chunk.streams).len(), group(attribute), &what);
                }
            }
        }
        sections::UNIT => map.push(length, ByteGroup::Container, "unit of the networks' distances"),
        sections::FRAME => map.push(length, ByteGroup::Container, "frame of the scene"),
        sections::DIRECTIONS => map.push(length, ByteGroup::Container, "degree of the view direction"),
        sections::VIEW => map.push(length, ByteGroup::Container, "near plane"),
        _ => map.push(length, ByteGroup::Container, "optional section of a later version"),
    }
    Ok(())
}

fn group(attribute: Attribute) -> ByteGroup {
    match attribute {
        Attribute::Features => ByteGroup::Features,
        Attribute::Scalings => ByteGroup::Scalings,
        Attribute::Offsets => ByteGroup::Offsets,
    }
}

/// Ranges laid end to end.
#[derive(Default)]
struct Map {
    ranges: Vec<ByteRange>,
    end: u64,
}

impl Map {
    fn push(&mut self, length: usize, group: ByteGroup, what: &str) {
        let length = length as u64;
        self.ranges.push(ByteRange { offset: self.end, length, group, what: what.to_owned() });
        self.end += length;
    }
}

fn count(ranges: &[ByteRange]) -> ByteCounts {
    let mut counts = ByteCounts::default();
    for range in ranges {
        let part = match range.group {
            ByteGroup::Container => &mut counts.container,
            ByteGroup::Positions => &mut counts.positions,
            ByteGroup::Networks => &mut counts.networks,
            ByteGroup::Planes => &mut counts.planes,
            ByteGroup::Masks => &mut counts.masks,
            ByteGroup::Features => &mut counts.features,
            ByteGroup::Scalings => &mut counts.scalings,
            ByteGroup::Offsets => &mut counts.offsets,
        };
        *part += range.length;
        counts.total += range.length;
    }
    counts
}

impl fmt::Display for Inspection {
    /// The text that people read: content, choices, provenance, then bytes by group, section and range.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let manifest = &self.manifest;
        let total = self.byte_counts.total;
        writeln!(f, ".tcgs version {}, arithmetic profile {}, {total} bytes", self.version, self.profile)?;
        writeln!(f)?;
        let voxel = manifest.lattice.voxel;
        let [x, y, z] = manifest.lattice.origin;
        let frame = self.frame;
        let offset = frame.offset();
        let rows = [
            ("anchors", manifest.anchors.to_string()),
            ("gaussians", manifest.gaussians.to_string()),
            ("feature width", manifest.feature_dim.to_string()),
            ("offsets per anchor", manifest.offsets_per_anchor.to_string()),
            ("anchors a chunk", manifest.chunk_anchors.to_string()),
            ("frame offset", format!("{} {} {} in the world", offset.x, offset.y, offset.z)),
            ("frame scale", format!("{} world units a unit", frame.scale())),
            ("voxel", format!("{voxel} ({} world units)", f64::from(voxel) * frame.scale())),
            ("origin", format!("{x} {y} {z} in the frame")),
            ("scene scale", self.scene_scale.length().to_string()),
            ("view degree", self.view_degree.to_string()),
            ("feature step", manifest.steps.feature.to_string()),
            (
                "scaling step",
                format!("{} ({} voxel)", manifest.steps.scaling, manifest.steps.scaling / voxel),
            ),
            ("offset step", manifest.steps.offset.to_string()),
            ("background", manifest.background.to_string()),
            ("world", "the dataset's own; cameras in OpenCV axes".to_owned()),
            ("color space", "sRGB".to_owned()),
            ("content SHA-256", self.content_sha256.to_string()),
            ("decode SHA-256", manifest.decode_sha256.to_string()),
            ("generator", manifest.provenance.generator.clone()),
            ("dataset SHA-256", or_dash(manifest.provenance.dataset.map(|digest| digest.to_string()))),
            ("adapter", or_dash(manifest.provenance.adapter.clone())),
            ("settings", manifest.provenance.settings.to_string()),
        ];
        for (name, value) in rows {
            writeln!(f, "{name:<18} {value}")?;
        }

        writeln!(f, "\n{:<24} {:<40} because", "choice", "value")?;
        for Explanation { what, value, because } in &self.choices {
            writeln!(f, "{what:<24} {value:<40} {because}")?;
        }

        writeln!(f, "\n{:<12} {:>10} {:>7} {:>13}", "bytes by part", "bytes", "share", "bytes/anchor")?;
        let counts = &self.byte_counts;
        for (name, bytes) in counts.parts().into_iter().chain([("total", counts.total)]) {
            let share = 100.0 * bytes as f64 / total.max(1) as f64;
            let each = bytes as f64 / manifest.anchors.max(1) as f64;
            writeln!(f, "{name:<13} {bytes:>10} {share:>6.2}% {each:>13.3}")?;
        }

        let columns = ["tables", "position", "tri-plane", "and neighbors"];
        write!(f, "\n{:<12} {:<14}", "context", "chosen")?;
        columns.iter().chain([&"regression"]).try_for_each(|column| write!(f, " {column:>14}"))?;
        writeln!(f, "   bytes with network, without planes")?;
        let groups = ["features", "scalings", "offsets"].iter().zip(&manifest.contexts);
        for ((name, context), regression) in groups.zip(self.regressions) {
            let chosen = match context.kind {
                None => columns[0],
                Some(ContextKind::Position) => columns[1],
                Some(ContextKind::TriPlane) => columns[2],
                Some(ContextKind::TriPlaneKnn) => columns[3],
            };
            write!(f, "{name:<12} {chosen:<14}")?;
            let GroupCosts { tables, position, tri_plane, tri_plane_knn } = context.bytes;
            for bytes in [tables, position, tri_plane, tri_plane_knn, regression] {
                write!(f, " {:>14}", or_dash(bytes.map(|bytes| bytes.to_string())))?;
            }
            writeln!(f)?;
        }

        writeln!(f, "\n{:<8} {:<11} {:>8} {:>10} {:>10}", "section", "name", "critical", "offset", "bytes")?;
        for section in &self.sections {
            let critical = if section.critical { "yes" } else { "no" };
            let SectionReport { id, name, offset, length, .. } = section;
            writeln!(f, "{id:<8} {name:<11} {critical:>8} {offset:>10} {length:>10}")?;
        }

        writeln!(f, "\n{:>10} {:>10}  {:<10} what", "offset", "bytes", "part")?;
        for range in &self.ranges {
            writeln!(f, "{:>10} {:>10}  {:<10} {}", range.offset, range.length, range.group, range.what)?;
        }
        Ok(())
    }
}

fn or_dash(text: Option<String>) -> String {
    text.unwrap_or_else(|| "-".to_owned())
}
