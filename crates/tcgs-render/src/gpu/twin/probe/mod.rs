//! The probe of subgroups.

mod subgroup_probe;

pub use subgroup_probe::subgroup_probe;
