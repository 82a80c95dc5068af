//! An S3 server in this process, for tests: buckets in memory behind real HTTP on loopback, with faults on request.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Method, Request};
use hyper_util::rt::TokioIo;
use md5::{Digest, Md5};
use s3s::auth::SimpleAuth;
use s3s::dto::{
    AbortMultipartUploadInput, AbortMultipartUploadOutput, CompleteMultipartUploadInput, CompleteMultipartUploadOutput,
    CreateBucketInput, CreateBucketOutput, CreateMultipartUploadInput, CreateMultipartUploadOutput, DeleteObjectsInput,
    DeleteObjectsOutput, ETag, GetObjectInput, GetObjectOutput, HeadObjectInput, HeadObjectOutput,
    ListMultipartUploadsInput, ListMultipartUploadsOutput, ListObjectsV2Input, ListObjectsV2Output, ListPartsInput,
    ListPartsOutput, MultipartUpload, Object, Part, PutObjectInput, PutObjectOutput, StreamingBlob, UploadPartInput,
    UploadPartOutput,
};
use s3s::service::{S3Service, S3ServiceBuilder};
use s3s::{Body, HttpError, HttpResponse, S3, S3Request, S3Response, S3Result, s3_error};

use super::{S3Key, S3Settings};

/// The name of the bucket that every server has.
pub const BUCKET: &str = "test-bucket";

/// What goes wrong, and how often: shares of 1000 requests, drawn from the seed and the number of the request.
#[derive(Clone, Copy, Debug, Default)]
pub struct S3Faults {
    /// Draws them.
    pub seed: u64,
    /// Answered with 503 SlowDown and not done.
    pub unavailable: u32,
    /// Answered with 403 and nothing else and not done, as MinIO of 2021 does while it starts.
    pub starting: u32,
    /// Done, but the connection ends before the answer.
    pub lost_reply: u32,
    /// GET: the connection ends in the middle of the body.
    pub cut_body: u32,
    /// Every request waits so long.
    pub latency: Duration,
}

/// A running server; ends with this value.
pub struct S3Server {
    endpoint: String,
    state: Arc<State>,
    task: tokio::task::JoinHandle<()>,
}

/// Key and parts of an upload by its name.
type Uploads = BTreeMap<String, (String, BTreeMap<i32, Bytes>)>;

#[derive(Default)]
struct State {
    objects: Mutex<BTreeMap<String, Bytes>>,
    /// Beside [`BUCKET`]; all share their objects.
    buckets: Mutex<BTreeSet<String>>,
    uploads: Mutex<Uploads>,
    parts: AtomicU64,
    faults: Mutex<S3Faults>,
    requests: AtomicU64,
    injected: AtomicU64,
    /// By key: how often its object was read.
    reads: Mutex<BTreeMap<String, u64>>,
}

impl S3Server {
    /// Starts on a free port of 127.0.0.1.
    ///
    /// # Panics
    /// When the port cannot be had.
    pub async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port on loopback");
        let endpoint = format!("http://{}", listener.local_addr().expect("its address"));
        let state = Arc::new(State::default());
        let mut builder = S3ServiceBuilder::new(Buckets(state.clone()));
        builder.set_auth(SimpleAuth::from_single("test-key", "test-secret"));
        let task = tokio::spawn(serve(listener, builder.build(), state.clone()));
        S3Server { endpoint, state, task }
    }

    /// How to reach it, with everything below `prefix`.
    pub fn settings(&self, prefix: &str) -> S3Settings {
        S3Settings {
            bucket: BUCKET.to_owned(),
            prefix: prefix.to_owned(),
            endpoint: Some(self.endpoint.clone()),
            region: "us-east-1".to_owned(),
            path_style: true,
            credentials: Self::key().into(),
        }
    }

    /// Whom it knows.
    pub fn key() -> S3Key {
        S3Key { access_key: "test-key".to_owned(), secret_key: "test-secret".to_owned(), session_token: None }
    }

    /// From now on, these.
    pub fn set_faults(&self, faults: S3Faults) {
        *lock(&self.state.faults) = faults;
    }

    /// Requests that came, and how many of them went wrong on purpose.
    pub fn requests(&self) -> (u64, u64) {
        (self.state.requests.load(Ordering::Relaxed), self.state.injected.load(Ordering::Relaxed))
    }

    /// Parts of uploads that came, and keys of uploads that have not ended.
    pub fn uploads(&self) -> (u64, Vec<String>) {
        let unfinished = lock(&self.state.uploads).values().map(|(key, _)| key.clone()).collect();
        (self.state.parts.load(Ordering::Relaxed), unfinished)
    }

    /// How often each object whose key begins so was read.
    pub fn reads(&self, prefix: &str) -> BTreeMap<String, u64> {
        let reads = lock(&self.state.reads);
        reads.iter().filter(|r| r.0.starts_with(prefix)).map(|(key, &n)| (key.clone(), n)).collect()
    }

    /// Puts an object past every rule, as another program would.
    pub fn put_raw(&self, path: &str, body: &'static [u8]) {
        lock(&self.state.objects).insert(path.to_owned(), Bytes::from_static(body));
    }
}

impl Drop for S3Server {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Fate {
    Served,
    Unavailable,
    Starting,
    LostReply,
    CutBody,
}

impl State {
    fn fate(&self, reads: bool) -> (Fate, Duration) {
        let faults = *lock(&self.faults);
        let number = self.requests.fetch_add(1, Ordering::Relaxed);
        let hash = blake3::hash(&[faults.seed.to_le_bytes(), number.to_le_bytes()].concat());
        let mut draw = u32::from_le_bytes(std::array::from_fn(|i| hash.as_bytes()[i])) % 1000;
        let cut_body = if reads { faults.cut_body } else { 0 };
        let shares = [
            (Fate::Unavailable, faults.unavailable),
            (Fate::Starting, faults.starting),
            (Fate::LostReply, faults.lost_reply),
            (Fate::CutBody, cut_body),
        ];
        for (fate, share) in shares {
            if draw < share {
                self.injected.fetch_add(1, Ordering::Relaxed);
                return (fate, faults.latency);
            }
            draw -= share;
        }
        (Fate::Served, faults.latency)
    }
}

async fn serve(listener: tokio::net::TcpListener, service: S3Service, state: Arc<State>) {
    // dropped, and the connections with it, when the server is
    let mut connections = tokio::task::JoinSet::new();
    while let Ok((socket, _)) = listener.accept().await {
        let (service, state) = (service.clone(), state.clone());
        connections.spawn(async move {
            let answer = service_fn(move |request| answer(service.clone(), state.clone(), request));
            // ends with an error when a fault cuts it or the client leaves: both are the client's to notice
            let _ = hyper::server::conn::http1::Builder::new().serve_connection(TokioIo::new(socket), answer).await;
        });
    }
}

async fn answer(service: S3Service, state: Arc<State>, request: Request<Incoming>) -> Result<HttpResponse, HttpError> {
    let (fate, latency) = state.fate(request.method() == Method::GET);
    if !latency.is_zero() {
        tokio::time::sleep(latency).await;
    }
    if fate == Fate::Unavailable {
        let body = "<Error><Code>SlowDown</Code><Message>on purpose</Message></Error>".to_owned();
        let response = hyper::Response::builder().status(503).body(Body::from(body));
        return response.map_err(|e| HttpError::new(Box::new(e)));
    }
    if fate == Fate::Starting {
        let response = hyper::Response::builder().status(403).body(Body::empty());
        return response.map_err(|e| HttpError::new(Box::new(e)));
    }
    let response = service.call(request.map(Body::from)).await?;
    match fate {
        Fate::LostReply => Err(HttpError::new("lost on purpose".into())),
        Fate::CutBody => {
            let (parts, body) = response.into_parts();
            let whole: Vec<Bytes> = body.into_stream().try_collect().await.map_err(HttpError::new)?;
            let whole = whole.concat();
            let half = Bytes::copy_from_slice(&whole[..whole.len() / 2]);
            let cut = stream::iter([Ok(half), Err(std::io::Error::other("cut on purpose"))]);
            Ok(HttpResponse::from_parts(parts, Body::from(StreamingBlob::wrap(cut))))
        }
        _ => Ok(response),
    }
}

struct Buckets(Arc<State>);

impl Buckets {
    fn objects(&self, bucket: &str) -> S3Result<MutexGuard<'_, BTreeMap<String, Bytes>>> {
        let is_there = bucket == BUCKET || lock(&self.0.buckets).contains(bucket);
        if is_there { Ok(lock(&self.0.objects)) } else { Err(s3_error!(NoSuchBucket)) }
    }

    /// What to do with an upload of this name and key.
    fn upload<T>(&self, name: &str, key: &str, with: impl FnOnce(&mut BTreeMap<i32, Bytes>) -> T) -> S3Result<T> {
        match lock(&self.0.uploads).get_mut(name) {
            Some((of, parts)) if of == key => Ok(with(parts)),
            _ => Err(s3_error!(NoSuchUpload)),
        }
    }
}

async fn read(body: Option<StreamingBlob>, length: Option<i64>) -> S3Result<Bytes> {
    let mut whole = Vec::new();
    if let Some(mut parts) = body {
        while let Some(part) = parts.next().await {
            whole.extend_from_slice(&part.map_err(|_| s3_error!(IncompleteBody))?);
        }
    }
    if length.is_some_and(|n| n != whole.len() as i64) {
        return Err(s3_error!(IncompleteBody));
    }
    Ok(whole.into())
}

/// What S3 calls a part, or an object that was put whole.
fn tag(body: &[u8]) -> ETag {
    ETag::Strong(Md5::digest(body).iter().map(|b| format!("{b:02x}")).collect())
}

#[async_trait]
impl S3 for Buckets {
    async fn put_object(&self, request: S3Request<PutObjectInput>) -> S3Result<S3Response<PutObjectOutput>> {
        let input = request.input;
        drop(self.objects(&input.bucket)?);
        let body = read(input.body, input.content_length).await?;
        self.objects(&input.bucket)?.insert(input.key, body);
        Ok(S3Response::new(PutObjectOutput::default()))
    }

    async fn create_bucket(&self, request: S3Request<CreateBucketInput>) -> S3Result<S3Response<CreateBucketOutput>> {
        let bucket = request.input.bucket;
        if bucket == BUCKET || !lock(&self.0.buckets).insert(bucket) {
            return Err(s3_error!(BucketAlreadyOwnedByYou));
        }
        Ok(S3Response::new(CreateBucketOutput::default()))
    }

    async fn create_multipart_upload(
        &self,
        request: S3Request<CreateMultipartUploadInput>,
    ) -> S3Result<S3Response<CreateMultipartUploadOutput>> {
        drop(self.objects(&request.input.bucket)?);
        let mut uploads = lock(&self.0.uploads);
        let name = format!("upload-{}", self.0.requests.load(Ordering::Relaxed));
        uploads.insert(name.clone(), (request.input.key, BTreeMap::new()));
        Ok(S3Response::new(CreateMultipartUploadOutput { upload_id: Some(name), ..Default::default() }))
    }

    async fn upload_part(&self, request: S3Request<UploadPartInput>) -> S3Result<S3Response<UploadPartOutput>> {
        let input = request.input;
        self.upload(&input.upload_id, &input.key, |_| ())?;
        let body = read(input.body, input.content_length).await?;
        self.0.parts.fetch_add(1, Ordering::Relaxed);
        let e_tag = Some(tag(&body));
        self.upload(&input.upload_id, &input.key, |parts| parts.insert(input.part_number, body))?;
        Ok(S3Response::new(UploadPartOutput { e_tag, ..Default::default() }))
    }

    /// Two to a page.
    async fn list_parts(&self, request: S3Request<ListPartsInput>) -> S3Result<S3Response<ListPartsOutput>> {
        let input = request.input;
        let after = input.part_number_marker.and_then(|m| m.to_string().parse().ok()).unwrap_or(0);
        let mut found: Vec<Part> = self.upload(&input.upload_id, &input.key, |parts| {
            let later = parts.range(after + 1..).take(3);
            let part = |(number, body): (&i32, &Bytes)| Part {
                part_number: Some(*number),
                size: Some(body.len() as i64),
                e_tag: Some(tag(body)),
                ..Default::default()
            };
            later.map(part).collect()
        })?;
        let truncated = found.len() > 2;
        found.truncate(2);
        let last = found.last().and_then(|p| p.part_number).filter(|_| truncated);
        let output = ListPartsOutput {
            is_truncated: Some(truncated),
            next_part_number_marker: last.map(|n| n.to_string().parse().expect("a number")),
            parts: Some(found),
            ..Default::default()
        };
        Ok(S3Response::new(output))
    }

    async fn list_multipart_uploads(
        &self,
        request: S3Request<ListMultipartUploadsInput>,
    ) -> S3Result<S3Response<ListMultipartUploadsOutput>> {
        let prefix = request.input.prefix.unwrap_or_default();
        let uploads = lock(&self.0.uploads);
        let found = uploads.iter().filter(|(_, (key, _))| key.starts_with(&prefix));
        let upload = |(name, (key, _)): (&String, &(String, BTreeMap<i32, Bytes>))| MultipartUpload {
            key: Some(key.clone()),
            upload_id: Some(name.clone()),
            ..Default::default()
        };
        let output = ListMultipartUploadsOutput { uploads: Some(found.map(upload).collect()), ..Default::default() };
        Ok(S3Response::new(output))
    }

    async fn complete_multipart_upload(
        &self,
        request: S3Request<CompleteMultipartUploadInput>,
    ) -> S3Result<S3Response<CompleteMultipartUploadOutput>> {
        let input = request.input;
        let wanted = input.multipart_upload.and_then(|u| u.parts).unwrap_or_default();
        let joined = self.upload(&input.upload_id, &input.key, |parts| {
            let one = |wanted: &s3s::dto::CompletedPart| {
                let body = parts.get(&wanted.part_number?)?;
                (wanted.e_tag.as_ref()? == &tag(body)).then(|| body.clone())
            };
            wanted.iter().map(one).collect::<Option<Vec<Bytes>>>()
        })?;
        let joined = joined.filter(|parts| !parts.is_empty()).ok_or_else(|| s3_error!(InvalidPart))?;
        self.objects(&input.bucket)?.insert(input.key, joined.concat().into());
        lock(&self.0.uploads).remove(&input.upload_id);
        Ok(S3Response::new(CompleteMultipartUploadOutput::default()))
    }

    async fn abort_multipart_upload(
        &self,
        request: S3Request<AbortMultipartUploadInput>,
    ) -> S3Result<S3Response<AbortMultipartUploadOutput>> {
        lock(&self.0.uploads).remove(&request.input.upload_id).ok_or_else(|| s3_error!(NoSuchUpload))?;
        Ok(S3Response::new(AbortMultipartUploadOutput::default()))
    }

    async fn get_object(&self, request: S3Request<GetObjectInput>) -> S3Result<S3Response<GetObjectOutput>> {
        let body = self.objects(&request.input.bucket)?.get(&request.input.key).cloned();
        let body = body.ok_or_else(|| s3_error!(NoSuchKey))?;
        *lock(&self.0.reads).entry(request.input.key.clone()).or_default() += 1;
        let length = body.len() as i64;
        // in parts, as a network would
        let parts: Vec<Bytes> =
            (0..body.len()).step_by(1 << 20).map(|i| body.slice(i..body.len().min(i + (1 << 20)))).collect();
        let body = StreamingBlob::wrap(stream::iter(parts.into_iter().map(Ok::<_, std::io::Error>)));
        let output = GetObjectOutput { body: Some(body), content_length: Some(length), ..Default::default() };
        Ok(S3Response::new(output))
    }

    async fn head_object(&self, request: S3Request<HeadObjectInput>) -> S3Result<S3Response<HeadObjectOutput>> {
        let objects = self.objects(&request.input.bucket)?;
        let body = objects.get(&request.input.key).ok_or_else(|| s3_error!(NoSuchKey))?;
        let output = HeadObjectOutput { content_length: Some(body.len() as i64), ..Default::default() };
        Ok(S3Response::new(output))
    }

    async fn list_objects_v2(
        &self,
        request: S3Request<ListObjectsV2Input>,
    ) -> S3Result<S3Response<ListObjectsV2Output>> {
        let input = request.input;
        let prefix = input.prefix.clone().unwrap_or_default();
        let after = input.continuation_token.or(input.start_after).unwrap_or_default();
        let most = usize::try_from(input.max_keys.unwrap_or(1000)).unwrap_or(0).min(1000);
        let objects = self.objects(&input.bucket)?;
        let mut found: Vec<Object> = objects
            .iter()
            .filter(|(key, _)| key.starts_with(&prefix) && **key > after)
            .take(most + 1)
            .map(|(key, body)| Object {
                key: Some(key.clone()),
                size: Some(body.len() as i64),
                e_tag: Some(tag(body)),
                ..Default::default()
            })
            .collect();
        let truncated = found.len() > most;
        found.truncate(most);
        let output = ListObjectsV2Output {
            next_continuation_token: found.last().filter(|_| truncated).and_then(|o| o.key.clone()),
            is_truncated: Some(truncated),
            key_count: Some(found.len() as i32),
            contents: Some(found),
            name: Some(input.bucket),
            prefix: input.prefix,
            ..Default::default()
        };
        Ok(S3Response::new(output))
    }

    async fn delete_objects(
        &self,
        request: S3Request<DeleteObjectsInput>,
    ) -> S3Result<S3Response<DeleteObjectsOutput>> {
        // as MinIO of 2021 does
        if !request.headers.contains_key("content-md5") {
            return Err(s3_error!(InvalidRequest, "Missing required header for this request: Content-Md5."));
        }
        if request.input.delete.objects.len() > 1000 {
            return Err(s3_error!(MalformedXML));
        }
        let mut objects = self.objects(&request.input.bucket)?;
        for object in request.input.delete.objects {
            objects.remove(&object.key);
        }
        Ok(S3Response::new(DeleteObjectsOutput::default()))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
