//! Scenes in SQLite.

use sqlx::{Row as _, SqliteConnection, sqlite::SqliteRow};

use super::{
    SqliteStore, accounts, idempotency, insert_blob, lists,
    rows::{blob, document, instant, json, micros, optional_id, parsed, unsigned},
};
use crate::{
    domain::{Digest, KeyId, SceneId},
    store::{Answer, NewScene, SceneCreation, SceneDeletion, ScenePage, SceneRecord, Scenes, StoreError},
};

/// A row of `scenes` joined with its dataset's `bytes`.
fn scene(row: &SqliteRow) -> Result<SceneRecord, StoreError> {
    Ok(SceneRecord {
        id: parsed("id", row.try_get("id")?)?,
        owner: optional_id(row, "owner")?,
        name: row.try_get("name")?,
        dataset: blob(row, "dataset")?,
        summary: document("summary", row.try_get("summary")?)?,
        version: unsigned(row, "version")?,
        created_at: instant("created_at", row.try_get("created_at")?)?,
    })
}

async fn select(connection: &mut SqliteConnection, id: SceneId) -> Result<Option<SceneRecord>, StoreError> {
    let row = sqlx::query(
        "SELECT scenes.*, blobs.bytes FROM scenes JOIN blobs ON blobs.digest = scenes.dataset WHERE scenes.id = ?",
    )
    .bind(id.to_string())
    .fetch_optional(connection)
    .await?;
    row.as_ref().map(scene).transpose()
}

async fn select_of_dataset(
    connection: &mut SqliteConnection,
    owner: Option<KeyId>,
    dataset: Digest,
) -> Result<Option<SceneRecord>, StoreError> {
    let row = sqlx::query(
        "SELECT scenes.*, blobs.bytes FROM scenes JOIN blobs ON blobs.digest = scenes.dataset
         WHERE scenes.dataset = ?1 AND scenes.owner IS ?2",
    )
    .bind(dataset.to_string())
    .bind(owner.map(|owner| owner.to_string()))
    .fetch_optional(connection)
    .await?;
    row.as_ref().map(scene).transpose()
}

impl SqliteStore {
    async fn insert_scene(&self, new: NewScene) -> Result<SceneCreation, StoreError> {
        let (mut tx, now) = self.begin().await?;
        let known = select_of_dataset(&mut tx, new.owner, new.dataset.digest).await?;
        let id = known.as_ref().map_or(new.id, |known| known.id);
        if known.is_none() {
            // The upload's own room becomes the scene's.
            if let Some(upload) = new.upload {
                sqlx::query("UPDATE uploads SET ended_at = ? WHERE id = ? AND ended_at IS NULL")
                    .bind(micros(now))
                    .bind(upload.to_string())
                    .execute(&mut *tx)
                    .await?;
            }
            accounts::admit_blob(&mut tx, self.policy.limits.max_bytes, new.owner, new.dataset).await?;
            insert_blob(&mut tx, new.dataset, now).await?;
            sqlx::query(
                "INSERT INTO scenes (id, owner, dataset, name, summary, created_at) VALUES (?, ?, ?, ?, ?, ?)",
            )
            .bind(id.to_string())
            .bind(new.owner.map(|owner| owner.to_string()))
            .bind(new.dataset.digest.to_string())
            .bind(&new.name)
            .bind(json(&new.summary)?)
            .bind(micros(now))
            .execute(&mut *tx)
            .await?;
        }
        if let Some(upload) = new.upload {
            sqlx::query("UPDATE uploads SET ended_at = IFNULL(ended_at, ?), scene = ? WHERE id = ?")
                .bind(micros(now))
                .bind(id.to_string())
                .bind(upload.to_string())
                .execute(&mut *tx)
                .await?;
        }
        if let Some(intent) = &new.intent {
            let status = if known.is_some() { 200 } else { 201 };
            let resource = id.to_string();
            idempotency::remember(&mut tx, intent, status, &resource, self.policy.remember, now).await?;
        }
        let creation = match known {
            Some(known) => SceneCreation::Known(known),
            None => SceneCreation::Created(select(&mut tx, id).await?.ok_or(sqlx::Error::RowNotFound)?),
        };
        tx.commit().await?;
        Ok(creation)
    }

    async fn list_scenes(
        &self,
        owner: Option<KeyId>,
        before: Option<ScenePage>,
        limit: u32,
    ) -> Result<Vec<SceneRecord>, StoreError> {
        let rows = lists::scenes(owner, before, limit).build().fetch_all(&self.readers).await?;
        rows.iter().map(scene).collect()
    }

    async fn remove_scene(
        &self,
        id: SceneId,
        version: Option<u64>,
    ) -> Result<Option<SceneDeletion>, StoreError> {
        let (mut tx, _) = self.begin().await?;
        let Some(record) = select(&mut tx, id).await? else { return Ok(None) };
        if version.is_some_and(|version| version != record.version) {
            return Ok(Some(SceneDeletion::Changed));
        }
        let row = sqlx::query(
            "SELECT COUNT(*) AS active FROM jobs INDEXED BY jobs_active_by_scene
             WHERE scene = ? AND state IN ('queued', 'running')",
        )
        .bind(id.to_string())
        .fetch_one(&mut *tx)
        .await?;
        let active: u64 = unsigned(&row, "active")?;
        if active > 0 {
            return Ok(Some(SceneDeletion::InUse(active)));
        }
        sqlx::query("DELETE FROM scenes WHERE id = ?").bind(id.to_string()).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(Some(SceneDeletion::Deleted))
    }
}

impl Scenes for SqliteStore {
    fn create_scene(&self, new: NewScene) -> Answer<'_, SceneCreation> {
        Box::pin(self.insert_scene(new))
    }

    fn scene(&self, id: SceneId) -> Answer<'_, Option<SceneRecord>> {
        Box::pin(async move {
            let mut tx = self.readers.begin().await?;
            select(&mut tx, id).await
        })
    }

    fn scene_of_dataset(&self, owner: Option<KeyId>, dataset: Digest) -> Answer<'_, Option<SceneRecord>> {
        Box::pin(async move {
            let mut tx = self.readers.begin().await?;
            select_of_dataset(&mut tx, owner, dataset).await
        })
    }

    fn scenes(
        &self,
        owner: Option<KeyId>,
        before: Option<ScenePage>,
        limit: u32,
    ) -> Answer<'_, Vec<SceneRecord>> {
        Box::pin(self.list_scenes(owner, before, limit))
    }

    fn delete_scene(&self, id: SceneId, version: Option<u64>) -> Answer<'_, Option<SceneDeletion>> {
        Box::pin(self.remove_scene(id, version))
    }
}
