// Guesses the word that somebody meant who mistyped one.
#ifndef REVISIT_CORE_BASE_SUGGESTION_H_
#define REVISIT_CORE_BASE_SUGGESTION_H_

#include <cstddef>
#include <string>
#include <vector>

namespace revisit {

// How many letters have to be left out, put in, replaced or swapped with their
// neighbour to make one word of the other (restricted Damerau-Levenshtein
// distance).
std::size_t EditDistance(const std::string& a, const std::string& b);

// The word of `known` that is most like `word`, if a third of its letters at
// most differ or it begins with `word`; otherwise empty.
std::string Suggestion(const std::string& word,
                       const std::vector<std::string>& known);

// Says of a mistyped word which one may be meant and which are allowed.
std::string MistypedWord(const std::string& word,
                         const std::vector<std::string>& known);

}  // namespace revisit

#endif  // REVISIT_CORE_BASE_SUGGESTION_H_
