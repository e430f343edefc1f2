// The bytes of a stored batch that holds columns, straight from the message in
// which they came.
#ifndef REVISIT_SERVER_RECORDS_STORED_COLUMNS_H_
#define REVISIT_SERVER_RECORDS_STORED_COLUMNS_H_

#include <string>

#include "server/fields/pose_columns.h"

namespace revisit::server {

// The columns as a serialized revisit.stored.PoseBatch. Copying them into that
// message and serializing the copy gives the same bytes, and takes longer. Only
// fields that are named here reach the store.
std::string EncodeColumns(const ColumnFields& columns);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_STORED_COLUMNS_H_
