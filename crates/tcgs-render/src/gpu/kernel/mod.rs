//! Kernels: one `.wgsl` file each, composed with the shared files, validated, and compiled into a pipeline. [`table`] lists them.

pub(super) mod table;

use std::collections::HashMap;

use naga_oil::compose::{
    ComposableModuleDescriptor, Composer, NagaModuleDescriptor, ShaderDefValue, ShaderLanguage, ShaderType,
};

use super::{GpuError, KernelVariant};

/// The text of a kernel and its name, which is the file's name and its entry point's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KernelSource {
    /// File name without extension.
    pub name: &'static str,
    /// WGSL with naga_oil imports.
    pub text: &'static str,
}

/// The kernel of that name in [`KERNELS`](crate::gpu::KERNELS).
#[macro_export]
macro_rules! kernel_source {
    ($name:literal) => {
        const { $crate::gpu::find_kernel($name) }
    };
}

pub use kernel_source;

/// Files that kernels import, by the path in their `#define_import_path` line, in dependency order.
const SHARED: &[(&str, &str)] = &[
    ("index", include_str!("../../../shaders/shared/index.wgsl")),
    ("permute", include_str!("../../../shaders/shared/permute.wgsl")),
    ("blocks", include_str!("../../../shaders/shared/blocks.wgsl")),
    ("runs", include_str!("../../../shaders/shared/runs.wgsl")),
    ("view", include_str!("../../../shaders/shared/view.wgsl")),
    ("splat", include_str!("../../../shaders/shared/splat.wgsl")),
    ("finite", include_str!("../../../shaders/shared/finite.wgsl")),
    ("geometry", include_str!("../../../shaders/shared/geometry.wgsl")),
    ("harmonics", include_str!("../../../shaders/shared/harmonics.wgsl")),
    ("anchor_view", include_str!("../../../shaders/shared/anchor_view.wgsl")),
    ("model", include_str!("../../../shaders/shared/model.wgsl")),
    ("plain", include_str!("../../../shaders/shared/plain.wgsl")),
    ("gaussian", include_str!("../../../shaders/shared/gaussian.wgsl")),
    ("quantize", include_str!("../../../shaders/shared/quantize.wgsl")),
    ("rate", include_str!("../../../shaders/shared/rate.wgsl")),
    ("context", include_str!("../../../shaders/shared/context.wgsl")),
    ("convolution", include_str!("../../../shaders/shared/convolution.wgsl")),
    ("ssim", include_str!("../../../shaders/shared/ssim.wgsl")),
    ("ssim_tile", include_str!("../../../shaders/shared/ssim_tile.wgsl")),
];

/// A compiled kernel.
#[derive(Debug)]
pub struct Kernel {
    pub(super) pipeline: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
    /// The kernel's name.
    pub name: &'static str,
    /// No other kernel or buffer of the device has it.
    pub(super) id: u64,
}

/// A composer with the shared files; needs no device. Parsing them is most of the cost of a kernel, so a device has one composer
/// for all of its kernels.
///
/// # Errors
/// [`GpuError::Kernel`] with the composer's message.
pub(super) fn composer() -> Result<Composer, GpuError> {
    let mut composer = Composer::default().with_capabilities(wgpu::naga::valid::Capabilities::all());
    for (path, text) in SHARED {
        let added = composer
            .add_composable_module(ComposableModuleDescriptor {
                source: text,
                file_path: path,
                language: ShaderLanguage::Wgsl,
                as_name: None,
                additional_imports: &[],
                shader_defs: HashMap::new(),
            })
            .map(|_| ());
        if let Err(error) = added {
            let error = error.emit_to_string(&composer);
            return Err(GpuError::Kernel { kernel: (*path).to_owned(), error });
        }
    }
    Ok(composer)
}

/// Composes a kernel and validates it; needs no device.
///
/// # Errors
/// [`GpuError::Kernel`] with the composer's or validator's message.
pub(super) fn compose(
    composer: &mut Composer,
    source: KernelSource,
    defs: &[(&str, u32)],
) -> Result<wgpu::naga::Module, GpuError> {
    let shader_defs =
        defs.iter().map(|(name, value)| ((*name).to_owned(), ShaderDefValue::UInt(*value))).collect();
    composer
        .make_naga_module(NagaModuleDescriptor {
            source: source.text,
            file_path: source.name,
            shader_type: ShaderType::Wgsl,
            shader_defs,
            additional_imports: &[],
        })
        .map_err(|error| GpuError::Kernel {
            kernel: source.name.to_owned(),
            error: error.emit_to_string(composer),
        })
}

impl Kernel {
    pub(super) fn compile(
        device: &wgpu::Device,
        composer: &mut Composer,
        source: KernelSource,
        defs: &[(&str, u32)],
        variant: KernelVariant,
        id: u64,
    ) -> Result<Self, GpuError> {
        let module = compose(composer, source, defs)?;
        // A page cannot wait for its faults: there, the device has them.
        let scope =
            (!cfg!(target_arch = "wasm32")).then(|| device.push_error_scope(wgpu::ErrorFilter::Validation));
        let module = shader_module(
            device,
            wgpu::ShaderModuleDescriptor {
                label: Some(source.name),
                source: wgpu::ShaderSource::Naga(std::borrow::Cow::Owned(module)),
            },
            variant,
        );
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(source.name),
            layout: None,
            module: &module,
            entry_point: None,
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..wgpu::PipelineCompilationOptions::default()
            },
            cache: None,
        });
        if let Some(error) = scope.and_then(|scope| pollster::block_on(scope.pop())) {
            return Err(GpuError::Kernel { kernel: source.name.to_owned(), error: error.to_string() });
        }
        let layout = pipeline.get_bind_group_layout(0);
        Ok(Self { pipeline, layout, name: source.name, id })
    }
}

/// The module of a kernel. On hardware, loops have no counter that ends them: without it a step of a million Gaussians takes 6.5 % less
/// time on an H100, and blending a sixth (docs/HARDWARE.md). Reads and writes stay within bounds.
#[allow(unsafe_code, reason = "wgpu asks for it where a check of its own is left out")]
fn shader_module(
    device: &wgpu::Device,
    descriptor: wgpu::ShaderModuleDescriptor<'_>,
    variant: KernelVariant,
) -> wgpu::ShaderModule {
    match variant {
        KernelVariant::Software => device.create_shader_module(descriptor),
        KernelVariant::Hardware => {
            let checks = wgpu::ShaderRuntimeChecks {
                force_loop_bounding: false,
                ..wgpu::ShaderRuntimeChecks::checked()
            };
            // SAFETY: every loop of every kernel ends: it counts up to a bound that it does not change, counts down to zero, or
            // clears a bit of a word each time.
            unsafe { device.create_shader_module_trusted(descriptor, checks) }
        }
    }
}

#[cfg(test)]
mod portable;

#[cfg(test)]
mod tests {
    use std::{
        collections::BTreeMap,
        fs,
        path::{Path, PathBuf},
    };

    use super::{
        table::{KERNELS, KernelEntry},
        *,
    };

    fn files(folder: &Path, extension: &str, into: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).expect("a readable folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                files(&path, extension, into);
            } else if path.extension().is_some_and(|found| found == extension) {
                into.push(path);
            }
        }
    }

    fn sources_of_all_crates(into: &mut Vec<PathBuf>) {
        let crates =
            fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("..")).expect("a readable folder");
        for member in crates {
            files(&member.expect("an entry").path().join("src"), "rs", into);
        }
    }

    #[test]
    fn every_kernel_validates_and_is_named_as_its_file() {
        let mut faults = Vec::new();
        let mut composer = composer().expect("the shared files");
        for KernelEntry { source, definitions, .. } in KERNELS {
            let name = source.name;
            for defs in definitions.all() {
                match compose(&mut composer, *source, &defs) {
                    Ok(module) => {
                        let entries: Vec<_> = module.entry_points.iter().map(|e| e.name.clone()).collect();
                        if entries != [name] {
                            faults.push(format!("{name}: its entry points are {entries:?}"));
                        }
                    }
                    Err(error) => faults.push(format!("{defs:?}: {error}")),
                }
            }
        }
        assert!(faults.is_empty(), "{}", faults.join("\n"));
    }

    #[test]
    fn a_kernel_does_not_depend_on_those_composed_before() {
        let source = table::find_kernel("spawn_gaussians");
        let made = |composer: &mut Composer, features: u32| {
            let defs = [("FEATURES", features), ("OFFSETS", 10)];
            format!("{:?}", compose(composer, source, &defs).expect("composed"))
        };
        let fresh = |features: u32| made(&mut composer().expect("the shared files"), features);
        let mut shared = composer().expect("the shared files");
        let broken = KernelSource { name: "broken", text: "fn broken() { nonsense }" };
        for features in [32, 50, 32] {
            assert!(made(&mut shared, features) == fresh(features), "{features} features");
            assert!(compose(&mut shared, broken, &[]).is_err());
        }
        assert!(fresh(32) != fresh(50));
    }

    /// The folders of twins have one file for each kernel, at its place, and no other file defines a function of its name.
    #[test]
    fn the_tree_of_twins_is_that_of_kernels() {
        let mut sources = Vec::new();
        sources_of_all_crates(&mut sources);
        let mut found = Vec::new();
        for path in sources {
            let names: Vec<_> = path.iter().map(|part| part.to_string_lossy()).collect();
            let Some(twin) = names.iter().position(|name| name == "twin") else { continue };
            let place = names[twin + 1..].join("/");
            let text = fs::read_to_string(&path).expect("readable");
            for name in KERNELS.iter().map(|entry| entry.source.name) {
                let defines = text.contains(&format!("pub fn {name}("));
                if defines || path.file_stem().is_some_and(|stem| stem == name) {
                    found.push((place.clone(), name, defines));
                }
            }
        }
        let twin = |entry: &KernelEntry| {
            let name = entry.source.name;
            (format!("{}/{name}.rs", entry.pass), name, true)
        };
        let mut expected: Vec<_> = KERNELS.iter().map(twin).collect();
        found.sort();
        expected.sort();
        assert_eq!(found, expected);
    }

    #[test]
    fn every_kernel_is_used_by_one_source_and_every_shared_file_is_listed() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut sources = Vec::new();
        sources_of_all_crates(&mut sources);
        let mut uses: BTreeMap<String, usize> = BTreeMap::new();
        for source in sources {
            let text = fs::read_to_string(source).expect("readable");
            for (start, mark) in text.match_indices("kernel_source!(\"") {
                let name = text[start + mark.len()..].split('"').next().expect("a name");
                *uses.entry(name.to_owned()).or_default() += 1;
            }
        }
        let expected: BTreeMap<_, _> =
            KERNELS.iter().map(|entry| (entry.source.name.to_owned(), 1)).collect();
        assert_eq!(uses, expected);
        let mut shared = Vec::new();
        files(&root.join("shaders/shared"), "wgsl", &mut shared);
        let mut shared: Vec<_> = shared
            .iter()
            .map(|path| path.file_stem().expect("a name").to_string_lossy().into_owned())
            .collect();
        let mut listed: Vec<_> = SHARED.iter().map(|(name, _)| (*name).to_owned()).collect();
        shared.sort();
        listed.sort();
        assert_eq!(shared, listed);
    }
}
