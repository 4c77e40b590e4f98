// What one file's loops ask of another's.
#pragma once

#include <cstdint>

extern "C" {

void straightpcf_knn(const float* points, int count, int dims, int rows, int k, int32_t* out);
void straightpcf_pack(const float* weight, int width, int out_width, float* packed);
void straightpcf_edge_max(const float* a, const float* b, const int32_t* index, const float* packed, int rows, int k,
                          int width, int out_width, float* out, uint8_t* arg);
void straightpcf_pack_fine(const float* weight, int width, int out_width, float* packed);
void straightpcf_edge_max_fine(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                               int count, int k, int width, int out_width, float* out);
void straightpcf_pack_coarse(const float* weight, int width, int out_width, float* packed);
void straightpcf_edge_max_coarse(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                                 int count, int k, int width, int out_width, float* out);
void straightpcf_linear(const float* x, int stride, const float* packed, const float* bias, int rows, int width,
                        int out_width, int relu, float* out);

}  // extern "C"
