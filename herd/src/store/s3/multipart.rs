//! Large files, in parts: what a connection that broke off has left is gone on with, by this process or a later one.
//!
//! A part that the server has counts by its MD5, which S3 gives as its tag (where it does not, by its own encryption, the part is sent again). An
//! upload is ended by the tags of all parts, so that the object is this file whatever somebody else has sent to the same upload.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use aws_sdk_s3::primitives::ByteStream;
use aws_sdk_s3::types::{CompletedMultipartUpload, CompletedPart};
use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use md5::{Digest, Md5};

use super::{S3Store, StoreError, patient};
use crate::store::unreadable;

/// Most that S3 takes as one object.
const LARGEST_FILE: u64 = 5 << 40;
/// Most parts of an upload, and S3's own limit is 10,000.
const MOST_PARTS: u64 = 9_000;
/// Parts in flight, each in memory.
const IN_FLIGHT: usize = 4;

/// From which size on files go in parts, and how large these are at least.
#[derive(Clone, Copy, Debug)]
pub(super) struct Parts {
    pub(super) above: u64,
    pub(super) least: u64,
}

impl Default for Parts {
    fn default() -> Self {
        // S3 wants 5 MiB at least
        Parts { above: 64 << 20, least: 8 << 20 }
    }
}

impl Parts {
    /// Size of the parts of a file, the last one's apart.
    fn of(&self, bytes: u64) -> u64 {
        self.least.max(bytes.div_ceil(MOST_PARTS))
    }
}

/// A part in memory.
struct Part {
    body: Bytes,
    sum: [u8; 16],
}

impl S3Store {
    /// Puts a file that was `bytes` long.
    pub(super) async fn put_parts(&self, key: &str, file: &Path, bytes: u64) -> Result<(), StoreError> {
        if bytes > LARGEST_FILE {
            let message = format!("{bytes} bytes, and S3 takes at most {LARGEST_FILE}: cut the file");
            return Err(StoreError::Denied { store: self.name.clone(), action: "put", key: key.to_owned(), message });
        }
        let (upload, known) = match self.unfinished(key).await? {
            Some(upload) => {
                let known = self.parts_of(key, &upload).await?;
                tracing::debug!(key, parts = known.len(), "an upload is gone on with");
                (upload, known)
            }
            None => (self.begin(key).await?, BTreeMap::new()),
        };
        let done = match self.send_all(key, file, bytes, &upload, &known).await {
            Ok(parts) => self.complete(key, bytes, &upload, parts).await,
            Err(e) => Err(e),
        };
        // what may pass is gone on with; else nothing is to be left
        if done.as_ref().is_err_and(|e| !matches!(e, StoreError::Unavailable { .. })) {
            let abort =
                self.client.abort_multipart_upload().bucket(&self.bucket).key(self.path(key)).upload_id(&upload);
            if let Err(e) = abort.send().await {
                tracing::warn!("{}", self.failure("give up the upload of", key, bytes, e));
            }
        }
        done
    }

    /// The newest upload of a key that was begun and not ended.
    pub(super) async fn unfinished(&self, key: &str) -> Result<Option<String>, StoreError> {
        let path = self.path(key);
        // MinIO lists those of a whole key only
        let listed = self.client.list_multipart_uploads().bucket(&self.bucket).prefix(&path).send().await;
        let listed = match listed.map_err(|e| self.failure("list uploads of", key, 0, e)) {
            Ok(listed) => listed,
            // a key that may put and not list: nothing is gone on with
            Err(StoreError::Denied { message, .. }) => {
                tracing::debug!(key, "uploads are not listed: {message}");
                return Ok(None);
            }
            Err(e) => return Err(e),
        };
        let ours = listed.uploads().iter().filter(|u| u.key() == Some(&path));
        let newest = ours.max_by_key(|u| u.initiated().map(|t| (t.secs(), t.subsec_nanos())));
        Ok(newest.and_then(|u| u.upload_id()).map(str::to_owned))
    }

    pub(super) async fn begin(&self, key: &str) -> Result<String, StoreError> {
        let begun = self.client.create_multipart_upload().bucket(&self.bucket).key(self.path(key)).send().await;
        let begun = begun.map_err(|e| self.failure("put", key, 0, e))?;
        begun.upload_id().map(str::to_owned).ok_or_else(|| self.broken("put", key, "the upload has no name"))
    }

    /// Size and tag of each part that is there, by number.
    pub(super) async fn parts_of(&self, key: &str, upload: &str) -> Result<BTreeMap<i32, (u64, String)>, StoreError> {
        let mut found = BTreeMap::new();
        let mut after: Option<String> = None;
        loop {
            let request = self.client.list_parts().bucket(&self.bucket).key(self.path(key)).upload_id(upload);
            let page = request.set_part_number_marker(after.clone()).send().await;
            let page = page.map_err(|e| self.passing(self.failure("list parts of", key, 0, e)))?;
            for part in page.parts() {
                let size = part.size().and_then(|n| u64::try_from(n).ok());
                if let (Some(number), Some(size), Some(tag)) = (part.part_number(), size, part.e_tag()) {
                    found.insert(number, (size, tag.to_owned()));
                }
            }
            let next = page.next_part_number_marker().map(str::to_owned);
            if page.is_truncated() != Some(true) || next.is_none() || next == after {
                return Ok(found);
            }
            after = next;
        }
    }

    /// Sends what is not there; number and tag of each part.
    pub(super) async fn send_all(
        &self,
        key: &str,
        file: &Path,
        bytes: u64,
        upload: &str,
        known: &BTreeMap<i32, (u64, String)>,
    ) -> Result<Vec<(i32, String)>, StoreError> {
        let size = self.parts.of(bytes);
        let send = |index: u64| {
            let (from, number) = (index * size, index as i32 + 1);
            let length = size.min(bytes - from);
            let there = known.get(&number).filter(|(known, _)| *known == length).map(|(_, tag)| tag.clone());
            self.send(key, file.to_owned(), upload, number, (from, length), there)
        };
        let sends = stream::iter((0..bytes.div_ceil(size)).map(send));
        let mut parts: Vec<(i32, String)> = sends.buffer_unordered(IN_FLIGHT).try_collect().await?;
        parts.sort_unstable();
        Ok(parts)
    }

    /// Sends a part, `range` being where it begins and how long it is, unless one with its tag is there.
    pub(super) async fn send(
        &self,
        key: &str,
        file: PathBuf,
        upload: &str,
        number: i32,
        range: (u64, u64),
        there: Option<String>,
    ) -> Result<(i32, String), StoreError> {
        let path = file.clone();
        let read = tokio::task::spawn_blocking(move || read_part(&path, range)).await;
        let read = read.map_err(|e| self.broken("put", key, e.to_string()))?;
        let part = read.map_err(|e| unreadable(self.name.clone(), &file, &e))?;
        let hex: String = part.sum.iter().map(|b| format!("{b:02x}")).collect();
        if let Some(tag) = there.filter(|tag| tag.trim_matches('"') == hex) {
            self.sent.fetch_add(range.1, Ordering::Relaxed);
            return Ok((number, tag));
        }
        let request = self.client.upload_part().bucket(&self.bucket).key(self.path(key)).upload_id(upload);
        let request = request.part_number(number).content_md5(aws_smithy_types::base64::encode(part.sum));
        let request = request.body(ByteStream::from(part.body)).customize().config_override(patient(range.1));
        let sent = request.send().await.map_err(|e| self.passing(self.failure("put", key, range.1, e)))?;
        self.sent.fetch_add(range.1, Ordering::Relaxed);
        let tag = sent.e_tag().map(str::to_owned);
        Ok((number, tag.ok_or_else(|| self.broken("put", key, "a part has no tag"))?))
    }

    async fn complete(&self, key: &str, bytes: u64, upload: &str, parts: Vec<(i32, String)>) -> Result<(), StoreError> {
        let part = |(number, tag)| CompletedPart::builder().part_number(number).e_tag(tag).build();
        let all = CompletedMultipartUpload::builder().set_parts(Some(parts.into_iter().map(part).collect())).build();
        let request =
            self.client.complete_multipart_upload().bucket(&self.bucket).key(self.path(key)).upload_id(upload);
        // the server joins the parts before it answers
        let request = request.multipart_upload(all).customize().config_override(patient(bytes));
        request.send().await.map(drop).map_err(|e| self.passing(self.failure("put", key, bytes, e)))
    }

    /// An upload that somebody else has ended, or added to, is begun anew.
    fn passing(&self, error: StoreError) -> StoreError {
        match error {
            StoreError::Denied { store, action, key, message }
                if ["NoSuchUpload", "InvalidPart"].iter().any(|code| message.starts_with(code)) =>
            {
                StoreError::Unavailable { store, action, key, message }
            }
            e => e,
        }
    }
}

fn read_part(file: &Path, (from, length): (u64, u64)) -> std::io::Result<Part> {
    let mut file = File::open(file)?;
    file.seek(SeekFrom::Start(from))?;
    let mut body = vec![0; length as usize];
    file.read_exact(&mut body)?;
    Ok(Part { sum: Md5::digest(&body).into(), body: body.into() })
}
