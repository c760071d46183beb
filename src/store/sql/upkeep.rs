//! What backups and checks ask of the database.

use std::path::Path;

use super::{
    Store, accounts,
    db::{Pool, query, values},
    rows::{self, micros},
};
use crate::{
    domain::Digest,
    store::{BlobRef, StoreError},
};

impl Store {
    /// Writes a copy of the database, as of one moment, into a new file. Others may read and write meanwhile.
    pub(in crate::store) async fn copy_into(&self, path: &Path) -> Result<(), StoreError> {
        let error = || StoreError::Corrupt { what: "path of a copy", error: path.display().to_string() };
        let path = path.to_str().ok_or_else(error)?;
        match &self.readers {
            Pool::Sqlite(_) => query("VACUUM INTO ?").bind(path).execute(&self.readers).await?,
            Pool::Postgres(_) => return Err(StoreError::NotInPostgres("copy")),
        };
        Ok(())
    }

    /// Up to `limit` blobs of the database after `after`, in the order of their digests.
    pub(in crate::store) async fn blob_rows(
        &self,
        after: Option<Digest>,
        limit: u32,
    ) -> Result<Vec<BlobRef>, StoreError> {
        query("SELECT digest, bytes FROM blobs WHERE digest > ? ORDER BY digest LIMIT ?")
            .bind_all(values![after.map(|digest| digest.to_string()).unwrap_or_default(), limit])
            .all(&self.readers, |row| rows::blob(row, "digest"))
            .await
    }

    /// Those of the blobs that nothing refers to, whether the database has them or not.
    pub(in crate::store) async fn without_references(
        &self,
        digests: &[Digest],
    ) -> Result<Vec<Digest>, StoreError> {
        self.read(async move |tx| accounts::unreferenced(tx, digests).await).await
    }

    /// Ends every open upload.
    pub(in crate::store) async fn end_uploads(&self) -> Result<(), StoreError> {
        self.write(async move |tx, now| {
            query("UPDATE uploads SET ended_at = ? WHERE ended_at IS NULL").bind(micros(now)).run(tx).await
        })
        .await
    }

    /// What SQLite finds wrong with the database's file and its references. PostgreSQL keeps references by itself, and has tools of its own
    /// (`pg_amcheck`) for its files; of it nothing is reported.
    pub(in crate::store) async fn integrity(&self) -> Result<Vec<String>, StoreError> {
        if matches!(self.readers, Pool::Postgres(_)) {
            return Ok(Vec::new());
        }
        self.read(async move |tx| {
            // As a table, it would take the number for the name of a table to check.
            let rows = query("PRAGMA integrity_check(20)").fetch_all(&mut *tx).await?;
            let found: Result<Vec<String>, sqlx::Error> =
                rows.iter().map(|row| row.try_get("integrity_check")).collect();
            let mut found = found?;
            found.retain(|line| line != "ok");
            let broken = query("SELECT DISTINCT \"table\", parent FROM pragma_foreign_key_check LIMIT 20")
                .fetch_all(tx)
                .await?;
            for row in &broken {
                let (table, parent): (String, String) = (row.try_get("table")?, row.try_get("parent")?);
                found.push(format!("rows of {table} refer to rows of {parent} that are not there"));
            }
            Ok(found)
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sql::open::temporary_store;

    #[tokio::test]
    async fn a_row_that_refers_to_nothing_is_a_fault_of_the_database() {
        let (_folder, store) = temporary_store().await;
        assert_eq!(store.integrity().await.expect("asked"), [""; 0]);
        query("PRAGMA foreign_keys = OFF").run(&store.writer).await.expect("set");
        let event = "INSERT INTO events (job_id, seq, at, kind, attempt, data) VALUES ('gone', 1, 0, 'state', 0, '{}')";
        query(event).run(&store.writer).await.expect("written");
        let found = store.integrity().await.expect("asked");
        assert_eq!(found, ["rows of events refer to rows of jobs that are not there"]);
    }
}
