//! Every change of the schemas: the files of `migrations`, which are parts of the program.

use std::{borrow::Cow, sync::LazyLock};

use sqlx::{
    SqlStr,
    migrate::{Migration, MigrationType, Migrator},
};

/// Files of one folder, named by version and description, in order.
macro_rules! migrations {
    ($folder:literal: $($name:literal,)+) => {
        LazyLock::new(|| migrator(&[$((
            $name,
            include_str!(concat!("../../../migrations/", $folder, "/", $name, ".sql")),
        )),+]))
    };
}

/// Migrations of SQLite databases.
pub static SQLITE: LazyLock<Migrator> = migrations! {
    "sqlite":
        "0001_queue",
        "0002_artifact_kinds",
        "0003_curve_artifacts",
        "0004_owners_and_scenes",
        "0005_uploads",
        "0006_idempotency_exports",
        "0007_series_webhooks",
        "0009_held_out_views",
        "0010_export_likeness",
        "0011_running_totals",
        "0012_indices_probe",
        "0013_setbacks",
        "0014_priority_ceiling",
        "0015_spz_versions",
        "0016_projects",
        "0017_series_ssim",
        "0018_publications",
        "0019_viewers",
        "0020_poses",
        "0021_kept_datasets",
        "0022_thumbnails",
        "0023_sessions",
        "0024_shares",
        "0025_export_formats",
        "0026_resume_from",
};

/// Migrations of PostgreSQL databases.
pub static POSTGRES: LazyLock<Migrator> = migrations! {
    "postgres":
        "0001_schema",
        "0002_publications",
        "0003_viewers",
        "0004_poses",
        "0005_kept_datasets",
        "0006_thumbnails",
        "0007_sessions",
        "0008_shares",
        "0009_export_formats",
        "0010_resume_from",
};

/// A migrator that records each file under its version and description.
fn migrator(files: &[(&'static str, &'static str)]) -> Migrator {
    let migration = |(name, text): &(&'static str, &'static str)| {
        let (version, description) = name.split_once('_').unwrap_or((name, ""));
        // Unreadable numbers cannot occur: a test reads the folders with the library's own reader and compares.
        let version = version.parse().unwrap_or_default();
        let description = Cow::Owned(description.replace('_', " "));
        Migration::new(version, description, MigrationType::Simple, SqlStr::from_static(text), false)
    };
    Migrator::with_migrations(files.iter().map(migration).collect())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[tokio::test]
    async fn the_program_has_every_file_of_the_folders() {
        for (folder, built_in) in [("sqlite", &SQLITE), ("postgres", &POSTGRES)] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations").join(folder);
            let read = Migrator::new(path).await.expect("readable files");
            let parts = |migrator: &Migrator| {
                let part =
                    |m: &Migration| (m.version, m.description.to_string(), m.checksum.to_vec(), m.no_tx);
                migrator.iter().map(part).collect::<Vec<_>>()
            };
            assert_eq!(parts(built_in), parts(&read), "{folder}");
        }
    }
}
