//! Shared links, and the secret that signs them. Links that have expired are removed when others are made.

use super::{
    Store,
    db::{Row, query, values},
    locks, rows,
    rows::micros,
};
use crate::{
    domain::{JobId, ShareId, ShareSecret},
    store::{NewShare, SHARES_PER_JOB, ShareRecord, StoreError, StoreFuture},
};

const SELECT: &str = "SELECT shares.*, jobs.project FROM shares JOIN jobs ON jobs.id = shares.job_id";

impl Store {
    /// The secret that signs links. The first one that is offered stays, whichever process offers it.
    pub fn share_secret(&self, offered: ShareSecret) -> StoreFuture<'_, ShareSecret> {
        self.call("share_secret").run(self.write(async move |tx, _| {
            query("INSERT INTO secrets (name, value) VALUES ('shares', ?) ON CONFLICT DO NOTHING")
                .bind(offered.expose())
                .run(&mut *tx)
                .await?;
            let row = query("SELECT value FROM secrets WHERE name = 'shares'").fetch_one(tx).await?;
            Ok(ShareSecret::stored(row.try_get("value")?))
        }))
    }

    /// Adds a link; `None` if the job has as many open ones as it may have, or is gone.
    pub fn create_share(&self, new: NewShare) -> StoreFuture<'_, Option<ShareRecord>> {
        self.call("create_share").run(self.write(async move |tx, now| {
            locks::job(tx, new.job).await?;
            query("DELETE FROM shares WHERE expires_at <= ?").bind(micros(now)).run(&mut *tx).await?;
            let job = new.job.to_string();
            let row = query("SELECT count(*) AS open FROM shares WHERE job_id = ?").bind(&job).fetch_one(&mut *tx).await?;
            if rows::integer::<u32>(&row, "open")? >= SHARES_PER_JOB {
                return Ok(None);
            }
            query(
                "INSERT INTO shares (id, job_id, target, created_by, created_at, expires_at) SELECT ?, id, ?, ?, ?, ? FROM jobs WHERE id = ?",
            )
            .bind_all(values![new.id.to_string(), &new.target, new.key.map(|key| key.to_string())])
            .bind_all(values![micros(now), micros(new.expires_at), &job])
            .run(&mut *tx)
            .await?;
            let mut made = query(SELECT);
            made.push(" WHERE shares.id = ").push_bind(new.id.to_string());
            made.optional(tx, share).await
        }))
    }

    /// A link that is open.
    pub fn share(&self, id: ShareId) -> StoreFuture<'_, Option<ShareRecord>> {
        self.call("share").run(async move {
            let now = self.now(&self.readers).await?;
            let mut found = query(SELECT);
            found.push(" WHERE shares.id = ").push_bind(id.to_string());
            found.push(" AND shares.expires_at > ").push_bind(micros(now));
            found.optional(&self.readers, share).await
        })
    }

    /// The open links of a job, newest first.
    pub fn shares(&self, job: JobId) -> StoreFuture<'_, Vec<ShareRecord>> {
        self.call("shares").run(async move {
            let now = self.now(&self.readers).await?;
            let mut all = query(SELECT);
            all.push(" WHERE shares.job_id = ").push_bind(job.to_string());
            all.push(" AND shares.expires_at > ").push_bind(micros(now));
            all.push(" ORDER BY shares.created_at DESC, shares.id DESC");
            all.all(&self.readers, share).await
        })
    }

    /// Closes a link of a job; false if it has no such link.
    pub fn delete_share(&self, job: JobId, id: ShareId) -> StoreFuture<'_, bool> {
        self.call("delete_share").run(self.write(async move |tx, _| {
            let row = query("DELETE FROM shares WHERE job_id = ? AND id = ? RETURNING id")
                .bind_all(values![job.to_string(), id.to_string()])
                .fetch_optional(tx)
                .await?;
            Ok(row.is_some())
        }))
    }
}

fn share(row: &Row) -> Result<ShareRecord, StoreError> {
    Ok(ShareRecord {
        id: rows::parsed("share", row.try_get("id")?)?,
        job: rows::parsed("job_id", row.try_get("job_id")?)?,
        project: rows::parsed("project", row.try_get("project")?)?,
        target: row.try_get("target")?,
        created_at: rows::instant("created_at", row.try_get("created_at")?)?,
        expires_at: rows::instant("expires_at", row.try_get("expires_at")?)?,
    })
}
