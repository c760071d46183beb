//! The command line, run as scripts and operators run it.

mod backup;
mod baselines;
mod bench_contexts;
mod bench_report;
mod bench_views;
mod check;
mod clients;
mod data_folder;
#[cfg(unix)]
mod database;
mod jobs;
mod keys;
mod options;
mod poses;
mod priority;
mod profile;
mod projects;
mod retention;
mod scripting;
mod signals;
mod upgrade;
