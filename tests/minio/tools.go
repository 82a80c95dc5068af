//go:build tools

// Package minio pins the S3 server of the tests: the last release of MinIO under the Apache licence
// (RELEASE.2021-04-22T15-44-28Z), built from its Go module.
package minio

import _ "github.com/minio/minio"
