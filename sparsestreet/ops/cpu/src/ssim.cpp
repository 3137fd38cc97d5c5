// Compiled once per instruction set, with the rules of arithmetic loosened so that the loops vectorize. A NaN in an
// image reaches the mean all the same: nothing here compares.
#include "ssim.hpp"

#include "kernels.h"

namespace SPLAT_VARIANT {
namespace {

template <class T>
splat::SimilarityKernels kernels() {
  return {[](const splat::ImagePair& pair, void* partials, void* mean) {
            ssim::similarity(pair, static_cast<T*>(partials), static_cast<T*>(mean));
          },
          [](const splat::ImagePair& pair, void* partials, const void* v_mean, void* v_image) {
            ssim::similarity_backward(pair, static_cast<T*>(partials), *static_cast<const T*>(v_mean),
                                      static_cast<T*>(v_image));
          }};
}

}  // namespace

void fill_similarity_kernels(splat::Kernels& k) {
  k.similarity[0] = kernels<float>(), k.similarity[1] = kernels<double>();
}

}  // namespace SPLAT_VARIANT
