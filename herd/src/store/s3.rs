//! Objects in an S3 bucket. Only this file knows S3.
//!
//! Plain S3 and nothing newer than what MinIO of 2021 has: put (large files in parts), get, head, list (version 2) and batch delete.

mod identity;
mod multipart;

use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use aws_sdk_s3::Client;
use aws_sdk_s3::config::http::HttpResponse;
use aws_sdk_s3::config::retry::RetryConfig;
use aws_sdk_s3::config::timeout::TimeoutConfig;
use aws_sdk_s3::config::{
    BehaviorVersion, Region, RequestChecksumCalculation, ResponseChecksumValidation, SharedHttpClient,
};
use aws_sdk_s3::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_s3::primitives::ByteStream;
use aws_sdk_s3::types::{Delete, ObjectIdentifier};
use aws_smithy_http_client::tls::Provider;
use aws_smithy_http_client::tls::rustls_provider::CryptoMode;
use bytes::{Bytes, BytesMut};
use md5::{Digest, Md5};
use tokio::io::AsyncWriteExt;

use super::{BlockStore, StoreError, Version, check_key, check_prefix};
pub use identity::{Identity, S3Credentials, S3Key};
use multipart::Parts;

/// Most that S3 takes in one put.
const LARGEST: u64 = 5 << 30;
/// To connect.
const CONNECT: Duration = Duration::from_secs(5);
/// From the end of a request to the head of its answer.
const ANSWER_SECONDS: u64 = 30;
/// Slowest line that is waited for, bytes per second.
const SLOWEST: u64 = 256 << 10;
/// Memory taken for an object on a server's word; more as it arrives.
const FIRST_ALLOCATION: u64 = 64 << 20;
/// Most keys in one batch delete.
const BATCH: usize = 1000;
/// Longest prefix of a store: with our longest key it stays below S3's 1024 bytes.
const LONGEST_PREFIX: usize = 200;

/// Which bucket, where, and as whom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct S3Settings {
    /// Name of the bucket.
    pub bucket: String,
    /// Where in the bucket all keys go, without slashes at its ends; may be empty.
    pub prefix: String,
    /// `http://host:port` or `https://host`; AWS itself when absent.
    pub endpoint: Option<String>,
    /// Region; most servers that are not AWS ignore it.
    pub region: String,
    /// `endpoint/bucket/key` instead of `bucket.endpoint/key`.
    pub path_style: bool,
    /// As whom.
    pub credentials: S3Credentials,
}

impl S3Settings {
    /// From `s3://bucket/prefix`, an endpoint (else `AWS_ENDPOINT_URL_S3`, `AWS_ENDPOINT_URL`, else AWS itself), and
    /// the environment: `AWS_REGION` (or `AWS_DEFAULT_REGION`, else us-east-1), `AWS_ACCESS_KEY_ID`,
    /// `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`; where there is no key, the identity that a cloud gives ([`Identity`]).
    pub fn from_url(url: &str, endpoint: Option<&str>) -> Result<Self, StoreError> {
        Self::from_url_and(url, endpoint, |name| std::env::var(name).ok().filter(|value| !value.is_empty()))
    }

    fn from_url_and(
        url: &str,
        endpoint: Option<&str>,
        variable: impl Fn(&str) -> Option<String>,
    ) -> Result<Self, StoreError> {
        let wrong = |message: String| StoreError::Misconfigured { store: url.to_owned(), message };
        let path = url.strip_prefix("s3://").ok_or_else(|| wrong("an S3 address is s3://bucket/prefix".to_owned()))?;
        let (bucket, prefix) = path.split_once('/').unwrap_or((path, ""));
        let endpoint = endpoint.map(str::to_owned);
        let endpoint = endpoint.or_else(|| variable("AWS_ENDPOINT_URL_S3")).or_else(|| variable("AWS_ENDPOINT_URL"));
        let credentials = S3Credentials::from_variables(&variable).map_err(wrong)?;
        let settings = S3Settings {
            bucket: bucket.to_owned(),
            prefix: prefix.trim_end_matches('/').to_owned(),
            region: variable("AWS_REGION")
                .or_else(|| variable("AWS_DEFAULT_REGION"))
                .unwrap_or_else(|| "us-east-1".to_owned()),
            // AWS wants names of buckets in the host; everybody else works without DNS entries per bucket
            path_style: endpoint.is_some(),
            endpoint,
            credentials,
        };
        settings.check()?;
        Ok(settings)
    }

    /// `s3://bucket/prefix`.
    pub fn url(&self) -> String {
        let slash = if self.prefix.is_empty() { "" } else { "/" };
        format!("s3://{}{slash}{}", self.bucket, self.prefix)
    }

    fn check(&self) -> Result<(), StoreError> {
        let wrong = |message: String| Err(StoreError::Misconfigured { store: self.url(), message });
        let plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || matches!(b, b'-' | b'.');
        if !(3..=63).contains(&self.bucket.len()) || !self.bucket.bytes().all(plain) {
            return wrong("a bucket's name has 3 to 63 lower case letters, digits, hyphens and dots".to_owned());
        }
        if !self.prefix.is_empty()
            && let Err(e) = check_key(&self.prefix)
        {
            return wrong(format!("the prefix cannot be used: {e}"));
        }
        if self.prefix.len() > LONGEST_PREFIX {
            return wrong(format!("the prefix is longer than {LONGEST_PREFIX} bytes"));
        }
        match self.endpoint.as_deref().map(|e| e.split_once("://")) {
            None => Ok(()),
            Some(Some(("http" | "https", host))) if !host.trim_matches('/').is_empty() => Ok(()),
            Some(_) => wrong(format!(
                "the endpoint {:?} is no http:// or https:// address",
                self.endpoint.as_deref().unwrap_or_default()
            )),
        }
    }
}

/// Objects in a bucket, below a prefix. Does not retry: [`super::Retrying`] does.
#[derive(Clone, Debug)]
pub struct S3Store {
    client: Client,
    bucket: String,
    /// Empty, or ending with a slash.
    prefix: String,
    name: String,
    /// Whether keys are asked for elsewhere, where that may fail for now.
    is_identity: bool,
    parts: Parts,
    sent: Arc<AtomicU64>,
}

impl S3Store {
    /// Makes the client, for a server that may not answer yet.
    pub fn new(settings: S3Settings) -> Result<Self, StoreError> {
        settings.check()?;
        Ok(S3Store {
            client: client(&settings),
            is_identity: matches!(settings.credentials, S3Credentials::Identity(_)),
            name: settings.url(),
            parts: Parts::default(),
            sent: Arc::default(),
            prefix: if settings.prefix.is_empty() { String::new() } else { settings.prefix + "/" },
            bucket: settings.bucket,
        })
    }

    /// Makes the client and looks whether the bucket answers.
    pub async fn connect(settings: S3Settings) -> Result<Self, StoreError> {
        let store = Self::new(settings)?;
        // listing, not heading the bucket: the answer to HEAD has no body that says why not
        let probe = store.client.list_objects_v2().bucket(&store.bucket).prefix(&store.prefix).max_keys(1).send();
        probe.await.map_err(|e| store.failure("open", "", 0, e))?;
        Ok(store)
    }

    /// Makes the bucket, unless it is there.
    ///
    /// # Errors
    /// When the server does not do it.
    pub async fn make_bucket(&self) -> Result<(), StoreError> {
        match self.client.create_bucket().bucket(&self.bucket).send().await {
            Ok(_) => Ok(()),
            Err(e) if e.code() == Some("BucketAlreadyOwnedByYou") => Ok(()),
            Err(e) => Err(self.failure("make the bucket", "", 0, e)),
        }
    }

    /// Bytes of files that were put so far, and of parts of them that were found there; goes up while a file is put.
    pub fn sent(&self) -> Arc<AtomicU64> {
        self.sent.clone()
    }

    fn path(&self, key: &str) -> String {
        format!("{}{key}", self.prefix)
    }

    /// What an SDK error means to the caller.
    fn failure<E>(&self, action: &'static str, key: &str, bytes: u64, error: SdkError<E, HttpResponse>) -> StoreError
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        let (store, key) = (self.name.clone(), key.to_owned());
        let service = match &error {
            SdkError::ServiceError(e) => e,
            // an identity is asked for first: whoever gives it may not answer now
            SdkError::ConstructionFailure(_) if !self.is_identity => {
                return StoreError::Denied { store, action, key, message: causes(&error) };
            }
            // no answer, half an answer, none in time
            _ => return StoreError::Unavailable { store, action, key, message: causes(&error) },
        };
        let status = service.raw().status().as_u16();
        let code = service.err().code().unwrap_or_default();
        let text = service.err().message().unwrap_or_default();
        let message = [code, text].into_iter().filter(|t| !t.is_empty()).collect::<Vec<_>>().join(": ");
        let message = if message.is_empty() { format!("HTTP {status}") } else { format!("{message} (HTTP {status})") };
        self.classify(action, key, bytes, status, code, message)
    }

    fn classify(
        &self,
        action: &'static str,
        key: String,
        bytes: u64,
        status: u16,
        code: &str,
        message: String,
    ) -> StoreError {
        let store = self.name.clone();
        match (code, status) {
            ("NoSuchBucket", _) => StoreError::NoBucket { store, bucket: self.bucket.clone() },
            ("NoSuchKey" | "NotFound", _) => StoreError::NotFound { store, key },
            // MinIO on a file system
            ("XMinioParentIsObject" | "XMinioObjectExistsAsDirectory", _) => {
                StoreError::InvalidKey { key, message: format!("a key cannot be a folder of another ({message})") }
            }
            ("XMinioStorageFull" | "QuotaExceeded" | "XMinioAdminBucketQuotaExceeded", _) | (_, 507) => {
                StoreError::Full { store, key, bytes }
            }
            ("RequestTimeTooSkewed", _) => {
                let message = format!("{message}: this machine's clock and the server's differ");
                StoreError::Denied { store, action, key, message }
            }
            ("PermanentRedirect" | "AuthorizationHeaderMalformed", _) => {
                let message = format!("{message}: the bucket is in another region (set AWS_REGION)");
                StoreError::Misconfigured { store, message }
            }
            // RequestTimeout comes with 400
            ("SlowDown" | "RequestTimeout" | "InternalError" | "ServiceUnavailable" | "OperationAborted", _)
            | (_, 408 | 429 | 500..=599) => StoreError::Unavailable { store, action, key, message },
            // whoever denies something says what; MinIO of 2021 answers so while it starts, before it knows its users
            ("", 403) => {
                let message = format!("{message}, without a reason: the server may still be starting");
                StoreError::Unavailable { store, action, key, message }
            }
            ("AccessDenied" | "AllAccessDisabled", _) => {
                let message = format!(
                    "{message}: its key may not do that in this bucket: have it allowed to list, get, put and delete objects there, or give \
                     another key"
                );
                StoreError::Denied { store, action, key, message }
            }
            ("InvalidAccessKeyId", _) => {
                let message =
                    format!("{message}: the server does not know this key: give another, or have it made there");
                StoreError::Denied { store, action, key, message }
            }
            _ => StoreError::Denied { store, action, key, message },
        }
    }

    fn check_size(&self, key: &str, bytes: u64) -> Result<(), StoreError> {
        if bytes <= LARGEST {
            return Ok(());
        }
        let message = format!("{bytes} bytes, and S3 takes at most {LARGEST} in one put: use smaller blocks");
        Err(StoreError::Denied { store: self.name.clone(), action: "put", key: key.to_owned(), message })
    }

    fn broken(&self, action: &'static str, key: &str, message: impl Into<String>) -> StoreError {
        StoreError::Unavailable { store: self.name.clone(), action, key: key.to_owned(), message: message.into() }
    }

    /// The body of an object, and how long the server says that it is.
    async fn open(&self, key: &str) -> Result<(ByteStream, u64), StoreError> {
        check_key(key)?;
        let request = self.client.get_object().bucket(&self.bucket).key(self.path(key)).send();
        let response = request.await.map_err(|e| self.failure("get", key, 0, e))?;
        let announced = response.content_length().and_then(|n| u64::try_from(n).ok());
        let length = announced.ok_or_else(|| self.broken("get", key, "the answer does not say how long it is"))?;
        Ok((response.body, length))
    }

    /// The next part of a body of which so many bytes have come; none at its end.
    async fn next(
        &self,
        key: &str,
        body: &mut ByteStream,
        came: u64,
        length: u64,
    ) -> Result<Option<Bytes>, StoreError> {
        match body.try_next().await {
            Ok(Some(part)) if came + part.len() as u64 <= length => Ok(Some(part)),
            Ok(Some(_)) => Err(self.broken("get", key, format!("more than {length} bytes came"))),
            Ok(None) if came == length => Ok(None),
            Ok(None) => Err(self.broken("get", key, format!("{came} of {length} bytes came"))),
            Err(e) => Err(self.broken("get", key, causes(&e))),
        }
    }

    /// Key, size, ETag and time of what begins with a prefix, ascending by key.
    async fn listed(&self, prefix: &str) -> Result<Vec<Listed>, StoreError> {
        check_prefix(prefix)?;
        let mut found = Vec::new();
        let mut from: Option<String> = None;
        loop {
            let request = self.client.list_objects_v2().bucket(&self.bucket).prefix(self.path(prefix));
            let request = request.set_continuation_token(from.clone()).send();
            let page = request.await.map_err(|e| self.failure("list", prefix, 0, e))?;
            for object in page.contents() {
                let key = object.key().and_then(|k| k.strip_prefix(&self.prefix));
                // what others put into the bucket under names that we do not use is not ours
                let Some(key) = key.filter(|k| check_key(k).is_ok()) else { continue };
                let bytes = object.size().and_then(|n| u64::try_from(n).ok()).unwrap_or(0);
                let tag = object.e_tag().map(|t| t.trim_matches('"').to_owned()).filter(|t| !t.is_empty());
                found.push((key.to_owned(), bytes, tag, object.last_modified().map(|t| t.secs())));
            }
            if page.is_truncated() != Some(true) {
                break;
            }
            let next = page.next_continuation_token().map(str::to_owned);
            if next.is_none() || next == from {
                return Err(self.broken("list", prefix, "a page names no next one"));
            }
            from = next;
        }
        // S3 sorts by bytes; not every server does
        found.sort_unstable();
        found.dedup();
        Ok(found)
    }

    async fn delete_batch(&self, keys: &[String]) -> Result<(), StoreError> {
        let first = &keys[0];
        let unbuildable = |e: aws_sdk_s3::error::BuildError| self.broken("delete", first, e.to_string());
        let objects: Result<Vec<_>, _> =
            keys.iter().map(|k| ObjectIdentifier::builder().key(self.path(k)).build()).collect();
        let batch = Delete::builder().set_objects(Some(objects.map_err(unbuildable)?)).quiet(true).build();
        let request = self.client.delete_objects().bucket(&self.bucket).delete(batch.map_err(unbuildable)?);
        // S3 takes any of several checksums here and the SDK sends a newer one, but MinIO of 2021 knows only this
        let request = request.customize().mutate_request(|http| {
            if let Some(sum) = http.body().bytes().map(Md5::digest) {
                http.headers_mut().insert("content-md5", aws_smithy_types::base64::encode(sum));
            }
        });
        let done = request.send().await.map_err(|e| self.failure("delete", first, 0, e))?;
        for error in done.errors() {
            let code = error.code().unwrap_or_default();
            if code == "NoSuchKey" {
                continue;
            }
            let path = error.key().unwrap_or_default();
            let key = path.strip_prefix(&self.prefix).unwrap_or(path).to_owned();
            let message = format!("{code}: {}", error.message().unwrap_or_default());
            return Err(self.classify("delete", key, 0, 200, code, message));
        }
        Ok(())
    }
}

#[async_trait]
impl BlockStore for S3Store {
    async fn put(&self, key: &str, body: Bytes) -> Result<(), StoreError> {
        check_key(key)?;
        let bytes = body.len() as u64;
        self.check_size(key, bytes)?;
        let request = self.client.put_object().bucket(&self.bucket).key(self.path(key)).body(ByteStream::from(body));
        let request = request.customize().config_override(patient(bytes));
        request.send().await.map(drop).map_err(|e| self.failure("put", key, bytes, e))
    }

    async fn put_file(&self, key: &str, file: &Path) -> Result<(), StoreError> {
        check_key(key)?;
        let failed = |e: &std::io::Error| super::unreadable(self.describe(), file, e);
        let length = tokio::fs::metadata(file).await.map_err(|e| failed(&e))?.len();
        if length > self.parts.above {
            return self.put_parts(key, file, length).await;
        }
        let path = file.to_owned();
        let summed = tokio::task::spawn_blocking(move || sum_of(&path)).await;
        let (bytes, sum) = summed.map_err(|e| self.broken("put", key, e.to_string()))?.map_err(|e| failed(&e))?;
        self.check_size(key, bytes)?;
        let body = ByteStream::from_path(file).await.map_err(|e| failed(&std::io::Error::other(e)))?;
        // what is sent in parts is not signed, so the server is told what to expect
        let request = self.client.put_object().bucket(&self.bucket).key(self.path(key)).body(body).content_md5(sum);
        request
            .customize()
            .config_override(patient(bytes))
            .send()
            .await
            .map_err(|e| self.failure("put", key, bytes, e))?;
        self.sent.fetch_add(bytes, Ordering::Relaxed);
        Ok(())
    }

    async fn get(&self, key: &str) -> Result<Bytes, StoreError> {
        let (mut body, length) = self.open(key).await?;
        if length > LARGEST {
            return Err(self.broken("get", key, format!("{length} bytes: more than is read into memory")));
        }
        // what a server announces is not memory yet
        let mut whole = BytesMut::with_capacity(length.min(FIRST_ALLOCATION) as usize);
        while let Some(part) = self.next(key, &mut body, whole.len() as u64, length).await? {
            whole.extend_from_slice(&part);
        }
        Ok(whole.freeze())
    }

    async fn get_file(&self, key: &str, file: &Path) -> Result<u64, StoreError> {
        let failed = |e: std::io::Error| super::unwritable(self.describe(), file, &e);
        let (mut body, length) = self.open(key).await?;
        let mut to = tokio::fs::File::create(file).await.map_err(failed)?;
        let mut bytes = 0;
        while let Some(part) = self.next(key, &mut body, bytes, length).await? {
            to.write_all(&part).await.map_err(failed)?;
            bytes += part.len() as u64;
        }
        to.flush().await.map_err(failed)?;
        Ok(bytes)
    }

    async fn size(&self, key: &str) -> Result<Option<u64>, StoreError> {
        check_key(key)?;
        let length = |length: Option<i64>| match length.map(u64::try_from) {
            Some(Ok(length)) => Ok(Some(length)),
            _ => Err(self.broken("size", key, "the answer does not say how long it is")),
        };
        let request = self.client.head_object().bucket(&self.bucket).key(self.path(key)).send();
        // HEAD's answers have no body, hence no code
        let (error, status) = match request.await {
            Ok(head) => return length(head.content_length()),
            Err(SdkError::ServiceError(e)) => {
                let status = e.raw().status().as_u16();
                (SdkError::ServiceError(e), status)
            }
            Err(e) => (e, 0),
        };
        match status {
            // the bucket was there in `connect`
            404 => Ok(None),
            // a GET is refused for the same reasons, and says which; its body is not read
            403 => match self.client.get_object().bucket(&self.bucket).key(self.path(key)).send().await {
                Ok(got) => length(got.content_length()),
                Err(e) => match self.failure("size", key, 0, e) {
                    StoreError::NotFound { .. } => Ok(None),
                    why => Err(why),
                },
            },
            _ => Err(self.failure("size", key, 0, error)),
        }
    }

    async fn list(&self, prefix: &str) -> Result<Vec<(String, u64)>, StoreError> {
        Ok(self.listed(prefix).await?.into_iter().map(|(key, bytes, ..)| (key, bytes)).collect())
    }

    async fn list_versions(&self, prefix: &str) -> Result<Option<Vec<Version>>, StoreError> {
        let all = self.listed(prefix).await?.into_iter();
        Ok(all.map(|(key, bytes, tag, put)| Some(Version { key, bytes, tag: tag?, put })).collect())
    }

    async fn delete(&self, keys: &[String]) -> Result<(), StoreError> {
        keys.iter().try_for_each(|key| check_key(key))?;
        for batch in keys.chunks(BATCH) {
            self.delete_batch(batch).await?;
        }
        Ok(())
    }

    fn describe(&self) -> String {
        self.name.clone()
    }
}

/// Key, size, ETag, time of the last put.
type Listed = (String, u64, Option<String>, Option<i64>);

/// Settings for a put of so many bytes: its answer comes after the whole body, which takes its time on a slow line.
fn patient(bytes: u64) -> aws_sdk_s3::config::Builder {
    let patience = Duration::from_secs(ANSWER_SECONDS + bytes / SLOWEST);
    let timeouts = TimeoutConfig::builder().connect_timeout(CONNECT).read_timeout(patience).build();
    aws_sdk_s3::Config::builder().timeout_config(timeouts)
}

/// Size of a file, and the Content-MD5 of what it holds.
fn sum_of(file: &Path) -> std::io::Result<(u64, String)> {
    let mut file = File::open(file)?;
    let (mut sum, mut bytes, mut part) = (Md5::new(), 0, vec![0; 1 << 20]);
    loop {
        match file.read(&mut part)? {
            0 => return Ok((bytes, aws_smithy_types::base64::encode(sum.finalize()))),
            n => {
                bytes += n as u64;
                sum.update(&part[..n]);
            }
        }
    }
}

/// The one place where S3 clients are made.
fn client(settings: &S3Settings) -> Client {
    let mut config = aws_sdk_s3::Config::builder()
        .behavior_version(BehaviorVersion::v2026_01_12())
        .http_client(http_client(settings))
        .credentials_provider(identity::provider(&settings.credentials, &settings.region, tls_client()))
        .region(Region::new(settings.region.clone()))
        .force_path_style(settings.path_style)
        // MinIO of 2021 and others do not know the checksums that the SDK adds by default since 2025
        .request_checksum_calculation(RequestChecksumCalculation::WhenRequired)
        .response_checksum_validation(ResponseChecksumValidation::WhenRequired)
        // the retrying layer counts and bounds retries, for every store alike
        .retry_config(RetryConfig::disabled())
        // to the head of the answer; `put` gives more. None for a whole operation: the SDK gives up on stalled downloads by itself
        .timeout_config(
            TimeoutConfig::builder().connect_timeout(CONNECT).read_timeout(Duration::from_secs(ANSWER_SECONDS)).build(),
        );
    if let Some(endpoint) = &settings.endpoint {
        config = config.endpoint_url(endpoint);
    }
    Client::from_conf(config.build())
}

/// Plain HTTP where the endpoint says so; else TLS by rustls with ring, the one crypto provider of the program.
fn http_client(settings: &S3Settings) -> SharedHttpClient {
    if settings.endpoint.as_deref().is_some_and(|e| e.starts_with("http://")) {
        return aws_smithy_http_client::Builder::new().build_http();
    }
    tls_client()
}

/// Speaks TLS, and plain HTTP where an address says so.
fn tls_client() -> SharedHttpClient {
    aws_smithy_http_client::Builder::new().tls_provider(Provider::Rustls(CryptoMode::Ring)).build_https()
}

/// An error with its causes in one line.
fn causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(e) = cause {
        let part = e.to_string();
        if !text.ends_with(&part) {
            text = format!("{text}: {part}");
        }
        cause = e.source();
    }
    text
}

#[cfg(test)]
mod tests;
