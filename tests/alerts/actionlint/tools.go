//go:build tools

// Package actionlint pins the program that looks through the workflow; in a module of its own, as it wants another YAML parser than promtool.
package actionlint

import _ "github.com/rhysd/actionlint/cmd/actionlint"
