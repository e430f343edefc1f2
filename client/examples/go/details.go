package main

import (
	"math/rand/v2"
	"time"

	"google.golang.org/genproto/googleapis/rpc/code"
	"google.golang.org/genproto/googleapis/rpc/errdetails"
	"google.golang.org/grpc/codes"
	"google.golang.org/grpc/status"
)

const attempts = 10

// details are what an error of revisit carries. Each may be missing, and all are where
// the error comes from the transport.
type details struct {
	info       *errdetails.ErrorInfo
	badRequest *errdetails.BadRequest
	retry      *errdetails.RetryInfo
}

func detailsOf(err error) details {
	var found details
	for _, detail := range status.Convert(err).Details() {
		switch detail := detail.(type) {
		case *errdetails.ErrorInfo:
			found.info = detail
		case *errdetails.BadRequest:
			found.badRequest = detail
		case *errdetails.RetryInfo:
			found.retry = detail
		}
	}
	return found
}

// waitBeforeRetry returns how long to wait before the stream is opened again, or false
// if that is of no use.
func waitBeforeRetry(err error, attempt int) (time.Duration, bool) {
	found := detailsOf(err)
	if attempt > attempts {
		return 0, false
	}
	if found.retry != nil {
		return found.retry.GetRetryDelay().AsDuration(), true
	}
	lost := status.Code(err) == codes.Unavailable ||
		status.Code(err) == codes.Internal && found.info == nil
	longest := min(2*time.Second, 100*time.Millisecond<<attempt)
	return longest/2 + rand.N(longest/2), lost
}

// codeName is the name of a status as all languages but Go write it.
func codeName(number codes.Code) string {
	return code.Code(number).String()
}
