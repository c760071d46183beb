//! The whole program with nothing faked: real processes, real disks, real power cuts.

#[cfg(target_os = "linux")]
mod crash_points;
mod durability;
mod examples_real;
mod first_light;
mod frame_times;
mod front;
#[cfg(target_os = "linux")]
mod full_disk;
mod gate;
mod hostile_datasets;
#[cfg(target_os = "linux")]
mod hostile_uploads;
#[cfg(target_os = "linux")]
mod io_faults;
mod killed;
mod machines;
mod page_faults;
mod photographs;
mod postgres;
mod power_cuts;
mod presets;
#[cfg(target_os = "linux")]
mod reordered;
#[cfg(target_os = "linux")]
mod soak;
mod upgrade;
mod viewer_page;
mod viewers;
