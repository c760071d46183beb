//! Problem documents (RFC 9457): the one form in which errors reach a user, over HTTP, in a failed job and on the command line.
//!
//! Every type of problem is a row of one table here; a test holds `docs/PROBLEMS.md` to it.

use std::{collections::BTreeMap, fmt};

use serde::{Deserialize, Serialize};

/// Prefix of every problem type.
pub const TYPE_PREFIX: &str = "urn:tcgs:problem:";

macro_rules! problem_types {
    ($($variant:ident = $status:literal, $name:literal, $title:literal;)*) => {
        /// What kind of problem a [`Problem`] is; `docs/PROBLEMS.md` says of each when it occurs and what to do.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum ProblemType {
            $(#[doc = $title] $variant,)*
        }

        impl ProblemType {
            /// Every type.
            pub const ALL: &[Self] = &[$(Self::$variant,)*];

            /// HTTP status, kebab-case name and title.
            const fn row(self) -> (u16, &'static str, &'static str) {
                match self {
                    $(Self::$variant => ($status, $name, $title),)*
                }
            }
        }
    };
}

problem_types! {
    BearerNeeded = 401, "bearer-needed", "The key is needed as a bearer token";
    InvalidKey = 401, "invalid-key", "The key is not valid";
    NoKey = 401, "no-key", "A key is needed";
    InsufficientScope = 403, "insufficient-scope", "The key does not allow this";
    CrossSiteRequest = 403, "cross-site-request", "Another site's request";
    ForeignHost = 421, "foreign-host", "Not a name of this service";
    NotFound = 404, "not-found", "Not Found";
    MethodNotAllowed = 405, "method-not-allowed", "Method Not Allowed";
    Refused = 400, "refused", "Refused";
    NotAcceptable = 406, "not-acceptable", "Not acceptable";
    BodyTimeout = 408, "body-timeout", "Body too slow";
    BodyIncomplete = 400, "body-incomplete", "Body incomplete";
    BodyTooLarge = 413, "body-too-large", "Body too large";
    UriTooLong = 414, "uri-too-long", "URI too long";
    HeadersTooLarge = 431, "headers-too-large", "Headers too large";
    UnsupportedMediaType = 415, "unsupported-media-type", "Unsupported media type";
    MalformedJson = 400, "malformed-json", "Malformed JSON";
    MalformedForm = 400, "malformed-form", "Malformed form";
    InvalidParameter = 422, "invalid-parameter", "Invalid parameter";
    InvalidHeader = 400, "invalid-header", "Invalid header";
    DigestMismatch = 400, "digest-mismatch", "Digest mismatch";
    PreconditionFailed = 412, "precondition-failed", "Precondition failed";
    RangeNotSatisfiable = 416, "range-not-satisfiable", "Range not satisfiable";
    InvalidIdempotencyKey = 422, "invalid-idempotency-key", "Invalid Idempotency-Key";
    IdempotencyInFlight = 409, "idempotency-in-flight", "Still being answered";
    IdempotencyKeyReused = 422, "idempotency-key-reused", "Idempotency-Key reused";
    TooManyRequests = 429, "too-many-requests", "Too many requests";
    TooManyFailures = 429, "too-many-failures", "Too many requests without a key";
    TooManyJobs = 429, "too-many-jobs", "Too many jobs at a time";
    TooManyUploads = 429, "too-many-uploads", "Too many open uploads";
    TooManyViews = 429, "too-many-views", "Too many views";
    TooManyStreams = 429, "too-many-streams", "Too many streams";
    QuotaExceeded = 507, "quota-exceeded", "Over the project's quota";
    StorageFull = 507, "storage-full", "Storage full";
    Busy = 503, "busy", "Busy";
    NotReady = 503, "not-ready", "Not ready";
    Internal = 500, "internal", "Internal error";
    JobNotFound = 404, "job-not-found", "No such job";
    SceneNotFound = 404, "scene-not-found", "No such dataset";
    UploadNotFound = 404, "upload-not-found", "No such upload";
    ArtifactNotFound = 404, "artifact-not-found", "No such file";
    ProjectNotFound = 404, "project-not-found", "No such project";
    KeyNotFound = 404, "key-not-found", "No such key";
    EndpointNotFound = 404, "endpoint-not-found", "No such webhook endpoint";
    ShareNotFound = 404, "share-not-found", "No such link";
    DeliveryNotFound = 404, "delivery-not-found", "No such delivery";
    FrameNotFound = 404, "frame-not-found", "No such frame";
    NoSuchLambda = 404, "no-such-lambda", "No such file";
    NoArtifact = 409, "no-artifact", "No file yet";
    JobActive = 409, "job-active", "The job is active";
    JobFinished = 409, "job-finished", "The job has finished";
    JobNotRetryable = 409, "job-not-retryable", "The job cannot be retried";
    SceneInUse = 409, "scene-in-use", "The dataset is in use";
    TusVersion = 412, "tus-version", "Other version of tus";
    OffsetMismatch = 409, "offset-mismatch", "Offset mismatch";
    ChecksumMismatch = 460, "checksum-mismatch", "Checksum mismatch";
    UploadLocked = 423, "upload-locked", "The upload is being written";
    UploadIncomplete = 409, "upload-incomplete", "Upload incomplete";
    UploadGone = 410, "upload-gone", "The upload has expired or was used";
    NoKeysYet = 409, "no-keys-yet", "The first key cannot be created over HTTP";
    DeliveryUnderWay = 409, "delivery-under-way", "The delivery cannot be made again";
    EndpointDisabled = 409, "endpoint-disabled", "The delivery cannot be made again";
    InvalidProjectRequest = 422, "invalid-project-request", "No such project can be made";
    InvalidKeyRequest = 422, "invalid-key-request", "No such key can be made";
    InvalidEndpoint = 422, "invalid-endpoint", "Invalid webhook endpoint";
    UrlNotAllowed = 422, "url-not-allowed", "URL not allowed";
    TooManyShares = 409, "too-many-shares", "Too many links";
    TooManyEndpoints = 409, "too-many-endpoints", "Too many endpoints";
    InvalidOption = 422, "invalid-option", "Invalid training option";
    NotAZip = 400, "not-a-zip", "Not a zip archive";
    ArchiveRejected = 422, "archive-rejected", "The archive was refused";
    DatasetRejected = 422, "dataset-rejected", "The dataset was refused";
    TableRejected = 422, "table-rejected", "A table of the dataset was refused";
    CameraRejected = 422, "camera-rejected", "A camera of the dataset was refused";
    PointsRejected = 422, "points-rejected", "The points of the dataset were refused";
    ImageRejected = 422, "image-rejected", "An image of the dataset was refused";
    DatasetTooLarge = 413, "dataset-too-large", "The dataset is too large";
    DatasetUnreadable = 500, "dataset-unreadable", "The dataset cannot be read";
    DatasetNotFound = 404, "dataset-not-found", "No such dataset";
    ReadingStopped = 503, "reading-stopped", "The reading was stopped";
    HostMemory = 507, "host-memory", "Not enough memory";
    DataDamaged = 500, "data-damaged", "The data folder is damaged";
    StorageFailed = 500, "storage-failed", "Storage failed";
    InvalidView = 422, "invalid-view", "Invalid view";
    ImpossibleView = 422, "impossible-view", "Impossible view";
    ViewTooLarge = 422, "view-too-large", "View too large";
    NotExportable = 422, "not-exportable", "The scene cannot be exported";
    Render = 500, "render", "The view could not be rendered";
    Undecodable = 422, "undecodable", "The file cannot be decoded";
    DeviceTimeout = 503, "device-timeout", "The device did not answer";
    DeviceLost = 503, "device-lost", "The device was lost";
    DeviceFault = 503, "device-fault", "The device rejected a command";
    GpuMemory = 507, "gpu-memory", "Not enough memory on the device";
    SceneTooLarge = 422, "scene-too-large", "The scene is too large for the adapter";
    DeadlineExceeded = 504, "deadline-exceeded", "The deadline has passed";
    TooFewPhotographs = 422, "too-few-photographs", "Too few photographs";
    FeaturelessPhotographs = 422, "featureless-photographs", "Nothing to recognize in the photographs";
    NoOverlap = 422, "no-overlap", "The photographs do not overlap";
    TooFewRegistered = 422, "too-few-registered", "Too few cameras were found";
    PosesTimedOut = 507, "poses-timed-out", "Cameras were not found in time";
    PosesFailed = 500, "poses-failed", "The search for cameras failed";
    PosesUnavailable = 503, "poses-unavailable", "Cameras cannot be found here";
    VideoRejected = 422, "video-rejected", "A video is unusable";
    VideoUnavailable = 503, "video-unavailable", "Videos cannot be read here";
    TrainingFailed = 422, "training-failed", "Training failed";
    MemoryBudget = 507, "memory-budget", "Not enough memory";
    EmptyCrop = 422, "empty-crop", "The crop leaves nothing";
    MaxBytesUnreachable = 507, "max-bytes-unreachable", "The file cannot be made so small";
    CheckpointRefused = 422, "checkpoint-refused", "The checkpoint cannot be used";
    PhotographLost = 500, "photograph-lost", "A photograph was lost";
    NotEncodable = 422, "not-encodable", "The scene cannot be encoded";
    LpipsWeights = 422, "lpips-weights", "The LPIPS weights cannot be used";
    LpipsImages = 422, "lpips-images", "The images cannot be compared by LPIPS";
    ResourceExhausted = 507, "resource-exhausted", "Resource exhausted";
    WorkerLost = 500, "worker-lost", "The worker was lost";
    WorkerPanicked = 500, "worker-panicked", "The run failed";
    Stalled = 500, "stalled", "The run has stalled";
    Usage = 400, "usage", "Wrong usage";
    UnreadableInput = 422, "unreadable-input", "The input cannot be read";
    UnwritableOutput = 507, "unwritable-output", "The output cannot be written";
    Exists = 409, "exists", "Something is there already";
    ImpossibleSize = 422, "impossible-size", "Impossible size";
    ImpossiblePose = 422, "impossible-pose", "The pose is not a camera";
    UnknownFrame = 404, "unknown-frame", "Unknown frame";
    ImageEncoding = 500, "image-encoding", "The image could not be encoded";
    InvalidDataset = 422, "invalid-dataset", "Invalid dataset";
    NotAScene = 422, "not-a-scene", "The input is not a scene";
    NoAdapter = 503, "no-adapter", "No usable adapter";
    NoViewer = 503, "no-viewer", "No viewer is alive";
    NoClient = 503, "no-client", "No HTTP client";
    Unreachable = 503, "unreachable", "The service cannot be reached";
    UnexpectedAnswer = 502, "unexpected-answer", "The service's answer is not one of its contract";
    Unavailable = 503, "unavailable", "Something needed is missing";
    AddressTaken = 503, "address-taken", "The address is taken";
    Stopped = 500, "stopped", "Stopped";
    JobCancelled = 500, "job-cancelled", "The job was cancelled";
    NoDatasets = 422, "no-datasets", "There is nothing to train on";
    ExternalFormatsFailed = 500, "external-formats-failed", "Conversion to other formats failed";
    NoPlace = 422, "no-place", "The tables have no place in the document";
    NotResults = 422, "not-results", "The results cannot be read";
    AccuracyBoundsExceeded = 500, "accuracy-bounds-exceeded", "Kernels are not accurate enough";
    SuiteIncomplete = 500, "suite-incomplete", "The suite is not complete";
}

impl ProblemType {
    /// The usual HTTP status.
    #[must_use]
    pub const fn status(self) -> u16 {
        self.row().0
    }

    /// The kebab-case name that follows [`TYPE_PREFIX`].
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.row().1
    }

    /// The title of all its problems.
    #[must_use]
    pub const fn title(self) -> &'static str {
        self.row().2
    }
}

/// A problem document.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    /// [`TYPE_PREFIX`] and a kebab-case name; a service of another version may use names that [`ProblemType`] lacks.
    #[serde(rename = "type")]
    pub kind: String,
    /// The same for every problem of the type.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What is wrong, where, and what to do.
    pub detail: String,
    /// The file of the upload that the problem is about, if it is about one.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub file: Option<String>,
    /// If a file cannot be as small as requested: the smallest size possible, in bytes.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub smallest_bytes: Option<u64>,
    /// If a service is not ready: each check by name, with `ok` or what is wrong.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub checks: BTreeMap<String, String>,
    /// Request id, if there was a request.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub instance: Option<String>,
}

impl Problem {
    /// A problem with its type's title and usual status.
    #[must_use]
    pub fn new(kind: ProblemType, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("{TYPE_PREFIX}{}", kind.name()),
            title: kind.title().to_owned(),
            status: kind.status(),
            detail: detail.into(),
            file: None,
            smallest_bytes: None,
            checks: BTreeMap::new(),
            instance: None,
        }
    }

    /// Whether this is a problem of a type.
    #[must_use]
    pub fn is(&self, kind: ProblemType) -> bool {
        self.kind.strip_prefix(TYPE_PREFIX) == Some(kind.name())
    }

    /// The same problem with another HTTP status than its type's.
    #[must_use]
    pub fn with_status(mut self, status: u16) -> Self {
        self.status = status;
        self
    }

    /// The same problem, naming the file that it is about.
    #[must_use]
    pub fn in_file(mut self, file: impl Into<String>) -> Self {
        self.file = Some(file.into());
        self
    }

    /// The same problem with the smallest possible size in bytes.
    #[must_use]
    pub fn with_smallest_bytes(mut self, bytes: u64) -> Self {
        self.smallest_bytes = Some(bytes);
        self
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.file {
            Some(file) => write!(f, "{}: {file}: {}", self.title, self.detail),
            None => write!(f, "{}: {}", self.title, self.detail),
        }
    }
}

impl std::error::Error for Problem {}
