//! Tests that kernels run on every back end: Metal, Direct3D, Vulkan and browsers.

use std::{
    fs,
    path::{Path, PathBuf},
};

use naga::{
    AddressSpace, Block, Module, Statement,
    back::{hlsl, msl, spv},
    valid::{Capabilities, ModuleInfo, ValidationFlags, Validator},
};

use super::{
    compose, composer,
    table::{KERNELS, KernelEntry},
};
use crate::gpu::adapter::STORAGE_BUFFERS_NEEDED;

/// Calls `check` with every kernel in every variant, and fails with all errors found.
fn each_kernel(mut check: impl FnMut(&str, &[(&str, u32)], &Module) -> Result<(), String>) {
    let mut composer = composer().expect("the shared files");
    let mut faults = Vec::new();
    for KernelEntry { source, definitions, .. } in KERNELS {
        let name = source.name;
        for defs in definitions.all() {
            let checked = compose(&mut composer, *source, &defs)
                .map_err(|error| error.to_string())
                .and_then(|module| check(name, &defs, &module));
            faults.extend(checked.err().map(|error| format!("{name} {defs:?}: {error}")));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn no_kernel_binds_more_storage_buffers_than_every_device_has() {
    each_kernel(|_, _, module| {
        let is_storage = |space| matches!(space, AddressSpace::Storage { .. });
        let bound = module.global_variables.iter().filter(|(_, variable)| is_storage(variable.space)).count();
        if bound <= STORAGE_BUFFERS_NEEDED as usize { Ok(()) } else { Err(format!("binds {bound}")) }
    });
}

/// Validates with subgroup operations as the only extension.
fn validated(module: &Module) -> Result<ModuleInfo, String> {
    Validator::new(ValidationFlags::all(), Capabilities::SUBGROUP)
        .validate(module)
        .map_err(|error| format!("{:?}", error.into_inner()))
}

#[test]
fn every_kernel_translates_to_the_languages_of_all_back_ends() {
    each_kernel(|name, _, module| {
        let info = validated(module)?;
        let options = spv::Options { lang_version: (1, 3), ..spv::Options::default() };
        let words =
            spv::write_vec(module, &info, &options, None).map_err(|error| format!("SPIR-V: {error}"))?;
        assert!(words.len() > 5, "{name}");
        let options = msl::Options { lang_version: (2, 1), ..msl::Options::default() };
        let (text, written) = msl::write_string(module, &info, &options, &msl::PipelineOptions::default())
            .map_err(|error| format!("MSL: {error}"))?;
        assert!(text.contains("kernel void"), "{name}");
        for entry in written.entry_point_names {
            entry.map_err(|error| format!("MSL: {error}"))?;
        }
        let target = hlsl::BindTarget { space: 1, ..hlsl::BindTarget::default() };
        let options = hlsl::Options {
            shader_model: hlsl::ShaderModel::V6_0,
            special_constants_binding: Some(target),
            ..hlsl::Options::default()
        };
        let mut text = String::new();
        let written = hlsl::Writer::new(&mut text, &options, &hlsl::PipelineOptions::default())
            .write(module, &info, None)
            .map_err(|error| format!("HLSL: {error}"))?;
        assert!(text.contains("numthreads"), "{name}");
        for entry in written.entry_point_names {
            entry.map_err(|error| format!("HLSL: {error}"))?;
        }
        Ok(())
    });
}

/// Whether a function is left from within a branch or a loop.
fn returns_early(block: &Block, is_nested: bool) -> bool {
    block.iter().any(|statement| match statement {
        Statement::Return { .. } => is_nested,
        Statement::Block(block) => returns_early(block, is_nested),
        Statement::If { accept, reject, .. } => returns_early(accept, true) || returns_early(reject, true),
        Statement::Switch { cases, .. } => cases.iter().any(|case| returns_early(&case.body, true)),
        Statement::Loop { body, continuing, .. } => {
            returns_early(body, true) || returns_early(continuing, true)
        }
        _ => false,
    })
}

/// Lanes that return early need not reconverge before the next subgroup operation, since wgpu does not ask drivers for maximal
/// reconvergence; lanes do reconverge at the end of an `if`. Where an `if` is a function's last statement, naga ends both
/// branches with a return.
#[test]
fn no_function_of_a_kernel_with_subgroups_returns_early() {
    let mut seen = 0;
    each_kernel(|_, defs, module| {
        if !defs.iter().any(|(name, _)| *name == "SUBGROUPS") {
            return Ok(());
        }
        let mut faults = Vec::new();
        for (_, function) in module.functions.iter() {
            seen += 1;
            if returns_early(&function.body, false) {
                faults.push(function.name.clone().unwrap_or_default());
            }
        }
        if faults.is_empty() { Ok(()) } else { Err(format!("{faults:?} return early")) }
    });
    assert!(seen > 100, "{seen}");
}

/// The shaders with their paths, without comments.
fn shaders() -> Vec<(PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders");
    let mut found = Vec::new();
    for folder in fs::read_dir(root).expect("shaders") {
        for entry in fs::read_dir(folder.expect("a folder").path()).expect("only folders") {
            let path = entry.expect("an entry").path();
            let text = fs::read_to_string(&path).expect("readable");
            let code = |line: &str| line.split("//").next().unwrap_or_default().to_owned();
            found.push((path, text.lines().map(code).collect::<Vec<_>>().join("\n")));
        }
    }
    assert!(found.len() > 60, "{}", found.len());
    found
}

fn is_operand(c: char) -> bool {
    c.is_alphanumeric() || "_.[]".contains(c)
}

/// Comparisons of a value with itself.
fn self_comparisons(code: &str) -> Vec<String> {
    let mut found = Vec::new();
    for operator in ["!=", "=="] {
        for (at, _) in code.match_indices(operator) {
            let left = code[..at].trim_end();
            let left = &left[left.trim_end_matches(is_operand).len()..];
            let right = code[at + operator.len()..].trim_start();
            let right = &right[..right.len() - right.trim_start_matches(is_operand).len()];
            if !left.is_empty() && left == right {
                found.push(format!("{left} {operator} {right}"));
            }
        }
    }
    found
}

/// Comparisons of a magnitude with a bound that only infinity, NaN and what is nearly infinite fail.
fn magnitude_guards(code: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (at, _) in code.match_indices("abs(") {
        let mut depth = 0;
        let end = code[at..].find(|c| {
            depth += i32::from(c == '(') - i32::from(c == ')');
            c == ')' && depth == 0
        });
        let rest = end.map_or("", |end| code[at + end + 1..].trim_start());
        let bound: String = rest.chars().take_while(|c| !")&|;{\n".contains(*c)).collect();
        if bound.starts_with('<') && (bound.contains("LIMIT") || bound.contains("e1") || bound.contains("e3"))
        {
            found.push(format!("abs(...) {bound}"));
        }
    }
    found
}

/// Compilers may assume that there is no NaN and no infinity, and remove comparisons that only those fail: `shared/finite.wgsl`
/// tests the bits instead.
#[test]
fn shaders_do_not_look_for_nan_by_comparing() {
    assert_eq!(self_comparisons("if x.y != x.y && a == b {"), ["x.y != x.y"]);
    assert_eq!(magnitude_guards("abs(g[i]) < vec4f(1e18); abs(w) <= OCTAVES").len(), 1);
    assert_eq!(magnitude_guards("select(0.0, v, abs(f(v)) < LIMIT)").len(), 1);
    for (path, code) in shaders() {
        assert_eq!(self_comparisons(&code), Vec::<String>::new(), "{}", path.display());
        assert_eq!(magnitude_guards(&code), Vec::<String>::new(), "{}", path.display());
    }
}

/// WGSL leaves `tanh` undefined where its exponential overflows.
#[test]
fn shaders_bound_what_they_take_the_hyperbolic_tangent_of() {
    for (path, code) in shaders() {
        let calls = code.matches("tanh(").count();
        let bounded = code.matches("tanh(clamp(").count();
        assert_eq!(calls, bounded, "{}", path.display());
    }
}
