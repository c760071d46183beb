//! Every kernel, in the folder of its pass, with the definitions that it is compiled with. Kernels are taken from here, and the tests that
//! validate and translate them read this table.

use super::{KernelSource, KernelVariant};

/// A kernel of the folder `shaders`.
#[derive(Debug, Clone, Copy)]
pub struct KernelEntry {
    /// Its folder.
    pub pass: &'static str,
    /// Its name and text.
    pub source: KernelSource,
    /// The definitions that it is compiled with.
    pub definitions: Definitions,
}

/// The sets of definitions that a kernel is compiled with.
#[derive(Debug, Clone, Copy)]
pub struct Definitions {
    /// Of each set the names with values; of values that depend on the scene or the adapter, examples.
    sets: &'static [&'static [(&'static str, u32)]],
    /// The model's numbers of features and of offsets are in each set, too.
    has_shape: bool,
    /// Software adapters have a variant of their own.
    has_variants: bool,
}

impl Definitions {
    const fn of_shape(self) -> Self {
        Self { has_shape: true, ..self }
    }

    const fn by_variant(self) -> Self {
        Self { has_variants: true, ..self }
    }

    /// Whether a kernel has definitions of these names.
    pub(in crate::gpu) fn has_names(&self, defs: &[(&str, u32)]) -> bool {
        let own = |name: &str| self.sets.iter().any(|set| set.iter().any(|(known, _)| *known == name));
        defs.iter()
            .all(|(name, _)| own(name) || (self.has_shape && SHAPE.iter().any(|(known, _)| known == name)))
    }

    /// Every set, on software adapters and on hardware, for a model of 32 features and 10 offsets.
    #[must_use]
    pub fn all(&self) -> Vec<Vec<(&'static str, u32)>> {
        let shape: &[_] = if self.has_shape { SHAPE } else { &[] };
        let hardware: Vec<_> = self.sets.iter().map(|set| [shape, set].concat()).collect();
        let software = KernelVariant::Software.defs();
        let software = hardware.iter().map(|set| [&set[..], software].concat()).filter(|_| self.has_variants);
        software.chain(hardware.clone()).collect()
    }
}

/// The shape of a model, as an example.
const SHAPE: &[(&str, u32)] = &[("FEATURES", 32), ("OFFSETS", 10)];

const fn sets(sets: &'static [&'static [(&'static str, u32)]]) -> Definitions {
    Definitions { sets, has_shape: false, has_variants: false }
}

const ONE: Definitions = sets(&[&[]]);
const DEGREE: Definitions = sets(&[&[("DEGREE", 0)], &[("DEGREE", 1)], &[("DEGREE", 2)], &[("DEGREE", 3)]]);
const MASKED_DEGREE: Definitions = sets(&[&[("DEGREE", 0)], &[("DEGREE", 0), ("MASKED", 1)]]);
const RUN: Definitions = sets(&[&[("RUN", 1)], &[("RUN", 16)]]);
/// For photographs of which all pixels count, and for those of which some do.
const MASKED: Definitions = sets(&[&[], &[("MASKED", 1)]]);
/// For each degree of the view direction, of all visible anchors and of the opaque ones.
const VIEW_DEGREES: Definitions = sets(&[
    &[("VIEW_DEGREE", 1)],
    &[("VIEW_DEGREE", 1), ("OPAQUE", 1)],
    &[("VIEW_DEGREE", 2)],
    &[("VIEW_DEGREE", 2), ("OPAQUE", 1)],
    &[("VIEW_DEGREE", 3)],
    &[("VIEW_DEGREE", 3), ("OPAQUE", 1)],
]);
const LANES: Definitions = sets(&[&[("LANES", 8)], &[("LANES", 16)], &[("LANES", 32)], &[("LANES", 64)]]);
/// As [`LANES`], and with the errors of corrected renders.
const LANES_CORRECTED: Definitions = sets(&[
    &[("LANES", 8)],
    &[("LANES", 16)],
    &[("LANES", 32)],
    &[("LANES", 64)],
    &[("LANES", 16), ("CORRECTED", 1)],
    &[("LANES", 64), ("CORRECTED", 1)],
]);
/// The modes of `dense`.
const MODES: Definitions = sets(&[&[("MODE", 0)], &[("MODE", 1)], &[("MODE", 2)]]);
/// Of one to 24 blocks, and of the modes of `dense_software`.
const BLOCKS: Definitions = sets(&[
    &[("BLOCKS", 1), ("MODE", 0)],
    &[("BLOCKS", 1), ("MODE", 1)],
    &[("BLOCKS", 1), ("MODE", 2)],
    &[("BLOCKS", 9), ("MODE", 0)],
    &[("BLOCKS", 9), ("MODE", 1)],
    &[("BLOCKS", 9), ("MODE", 2)],
    &[("BLOCKS", 24), ("MODE", 0)],
    &[("BLOCKS", 24), ("MODE", 1)],
    &[("BLOCKS", 24), ("MODE", 2)],
]);
const SUBGROUPS: Definitions = sets(&[
    &[("GRADIENT_LANES", 64)],
    &[("SUBGROUPS", 8), ("GRADIENT_LANES", 8)],
    &[("SUBGROUPS", 16), ("GRADIENT_LANES", 16)],
    &[("SUBGROUPS", 32), ("GRADIENT_LANES", 32)],
    &[("SUBGROUPS", 64), ("GRADIENT_LANES", 64)],
    &[("SUBGROUPS", 8), ("GRADIENT_LANES", 8), ("EIGHT_LANES", 1)],
    &[("SUBGROUPS", 8), ("GRADIENT_LANES", 8), ("EIGHT_LANES", 1), ("ONE_SUBGROUP", 1)],
    &[("SUBGROUPS", 32), ("GRADIENT_LANES", 32), ("ONE_SUBGROUP", 1)],
]);

macro_rules! kernels {
    ($($pass:literal { $($name:literal: $definitions:expr,)+ })+) => {
        /// All kernels.
        pub const KERNELS: &[KernelEntry] = &[$($(
            KernelEntry {
                pass: $pass,
                source: KernelSource {
                    name: $name,
                    text: include_str!(
                        concat!(env!("CARGO_MANIFEST_DIR"), "/shaders/", $pass, "/", $name, ".wgsl")
                    ),
                },
                definitions: $definitions,
            },
        )+)+];
    };
}

kernels! {
    "scan" {
        "scan_reduce": ONE,
        "scan_partials": ONE,
        "scan_apply": ONE,
        "scan_block_sums": ONE,
        "scan_blocks": ONE,
    }
    "sort" {
        "sort_count": ONE,
        "sort_offsets": ONE,
        "sort_scatter": ONE,
        "radix_histogram": ONE,
        "radix_scan": ONE,
        "radix_scatter": ONE,
    }
    "dense" {
        "dense": MODES,
        "dense_weight_gradient": SUBGROUPS,
        "sum_partials": ONE,
        "dense_software": BLOCKS.by_variant(),
        "dense_weight_gradient_software": ONE.by_variant(),
        "pack_weights": ONE,
        "sum_weight_gradient": ONE,
    }
    "neural" {
        "anchor_visible": ONE.of_shape(),
        "compact_anchors": ONE,
        "count_visible_anchors": ONE,
        "list_visible_anchors": ONE,
        "opaque_anchors": ONE.of_shape().by_variant(),
        "network_input": VIEW_DEGREES.of_shape().by_variant(),
        "visible_offsets": ONE.of_shape().by_variant(),
        "spawn_gaussians": ONE.of_shape().by_variant(),
        "count_gaussians": ONE.of_shape().by_variant(),
        "spawn_gradient": ONE.of_shape().by_variant(),
        "feature_gradient": ONE.of_shape().by_variant(),
        "anchor_statistics": MASKED.of_shape().by_variant(),
    }
    "plain" {
        "shade_gaussians": DEGREE,
        "shade_gradient": DEGREE.by_variant(),
        "gaussian_statistics": MASKED_DEGREE,
    }
    "raster" {
        "project": RUN.by_variant(),
        "compact": ONE.by_variant(),
        "tile_counts": ONE.by_variant(),
        "emit": ONE.by_variant(),
        "tile_ranges": ONE.by_variant(),
        "raster_forward": SUBGROUPS.by_variant(),
        "raster_backward": SUBGROUPS.by_variant(),
        "removal_loss": LANES_CORRECTED,
        "gather": ONE.by_variant(),
        "clear_culled": ONE.by_variant(),
        "project_backward": ONE.by_variant(),
    }
    "picture" {
        "pack_image": ONE,
        "shade_depth": ONE,
    }
    "loss" {
        "ssim_rows": MASKED,
        "ssim_columns": MASKED,
        "image_gradient": MASKED,
        "ssim_tiles": MASKED,
        "image_gradient_tiles": MASKED,
        "sum_losses": ONE.by_variant(),
        "wavelet": MASKED,
    }
    "exposure" {
        "correct_colors": ONE,
        "correct_colors_gradient": ONE,
        "correction_step": ONE,
    }
    "masks" {
        "mask_loss": ONE.of_shape(),
        "mask_gradient": ONE.of_shape().by_variant(),
        "mask_bits": ONE.of_shape(),
        "mask_rate": ONE.of_shape(),
    }
    "context" {
        "context_input": ONE.by_variant(),
        "neighbor_gradient": ONE,
        "plane_gradient": ONE,
        "plane_l1": ONE,
        "round_latents": ONE,
        "conv_down": ONE,
        "conv_up": ONE,
        "conv_weight_gradient": ONE,
        "round_weights": ONE,
        "round_rows": ONE,
        "quantize_rows": ONE.of_shape().by_variant(),
        "quantize_gradient": ONE.of_shape(),
        "rate": ONE.of_shape(),
        "refresh_quant_steps": ONE,
        "sum_bits": ONE,
        "freeze_quant_steps": ONE,
        "frozen_quant_step_gradient": ONE,
    }
    "optimizer" {
        "adam": ONE,
    }
    "probe" {
        "subgroup_probe": LANES,
    }
}

/// The kernel of that name; evaluated when the program is compiled, which fails if there is none.
#[must_use]
pub const fn find_kernel(name: &str) -> KernelSource {
    let mut index = 0;
    while index < KERNELS.len() {
        let source = KERNELS[index].source;
        if is_equal(source.name.as_bytes(), name.as_bytes()) {
            return source;
        }
        index += 1;
    }
    panic!("there is no kernel of this name")
}

const fn is_equal(one: &[u8], other: &[u8]) -> bool {
    let mut index = 0;
    while index < one.len() && index < other.len() && one[index] == other[index] {
        index += 1;
    }
    index == one.len() && index == other.len()
}

/// Whether a kernel may be compiled with such definitions. Kernels of tests and benchmarks, which are not in the table, may have any.
pub(in crate::gpu) fn knows(name: &str, defs: &[(&str, u32)]) -> bool {
    KERNELS
        .iter()
        .find(|entry| entry.source.name == name)
        .is_none_or(|entry| entry.definitions.has_names(defs))
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeSet, fs, path::Path};

    use super::*;

    #[test]
    fn the_table_has_every_file_of_the_folders() {
        let shaders = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
        let mut files = BTreeSet::new();
        for folder in fs::read_dir(shaders).expect("readable") {
            let folder = folder.expect("a folder").path();
            for file in fs::read_dir(&folder).expect("only folders") {
                let part = |path: &Path| path.file_name().expect("a name").to_string_lossy().into_owned();
                files.insert(format!("{}/{}", part(&folder), part(&file.expect("a file").path())));
            }
        }
        files.retain(|file| !file.starts_with("shared/"));
        let path = |entry: &KernelEntry| format!("{}/{}.wgsl", entry.pass, entry.source.name);
        assert_eq!(files, KERNELS.iter().map(path).collect());
    }

    #[test]
    fn kernels_share_the_linear_index_and_the_short_names_of_vectors() {
        let longhand = ["65535u", "vec2<f32>", "vec3<f32>", "vec4<f32>", "vec3<u32>"];
        for KernelEntry { source, .. } in KERNELS {
            for text in longhand {
                assert!(
                    !source.text.contains(text),
                    "{}: `{text}`; see shaders/shared/index.wgsl",
                    source.name
                );
            }
        }
    }

    #[test]
    fn kernels_are_known_by_their_definitions() {
        assert_eq!(find_kernel("rate").name, "rate");
        assert!(knows("project", &[("RUN", 4)]) && !knows("project", &[("LANES", 4)]));
        assert!(knows("spawn_gaussians", &[("OFFSETS", 4)]) && !knows("project", &[("OFFSETS", 4)]));
        assert!(knows("a probe", &[("LANES", 4)]));
    }
}
